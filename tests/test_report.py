"""Reports and comparisons: what is in them, and that a real browser shows and turns it."""

import json
import re
import shutil
import subprocess
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
from matplotlib.legend import Legend

from hand_pose_ros.cli import main
from hand_pose_ros.evaluation import metrics, plots
from hand_pose_ros.evaluation.published import DATASETS
from hand_pose_ros.evaluation.report import write_report
from hand_pose_ros.evaluation.results import Result, named_apart
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import FINGERS, HAND21, get_skeleton
from hand_pose_ros.training.figures import runtime

CAMERA = Intrinsics(400, 400, 159.5, 119.5, 320, 240)


def flat_hand(rng):
    """A hand with spread fingers, about 18 cm long, half a metre away."""
    joints = np.zeros((21, 3))
    for finger, angle in enumerate(np.radians([-60, -18, 0, 14, 30])):
        reach = np.array([0.03, 0.06, 0.09, 0.11]) if finger == 0 else np.array([0.085, 0.125, 0.15, 0.17])
        joints[1 + 4 * finger:5 + 4 * finger] = reach[:, None] * [np.sin(angle), -np.cos(angle), 0]
    return joints + np.array([0, 0.08, 0.5]) + rng.normal(0, 0.02, 3)


@pytest.fixture
def result():
    rng = np.random.default_rng(0)
    truth = np.stack([flat_hand(rng) for _ in range(40)])
    predictions = truth + rng.normal(0, 0.004, truth.shape) * np.linspace(0.1, 5, 40)[:, None, None]
    predictions[7] = np.nan
    return Result('ours <&> others', HAND21, CAMERA, predictions, truth, 33_000_000 * np.arange(40),
                  {'predict': rng.uniform(0.001, 0.002, 40), 'total': rng.uniform(0.003, 0.004, 40)},
                  notes=('one image was <odd>',), info={'model': 'm', 'frames_per_s': 321.0})


def depth_images(result):
    """A disc of 3 cm around each true joint, before a wall, and something beside the hand."""
    def read(rows):
        images = {}
        for row in rows:
            image = np.full((240, 320), 0.75, np.float32)
            image[:, :12] = 0.5
            for (u, v), (_, _, z) in zip(CAMERA.project(result.truth[row]), result.truth[row], strict=True):
                cv2.circle(image, (round(u), round(v)), 12, float(z), -1)
            images[row] = image
        return images
    return read


def test_report_is_one_file_that_needs_nothing_else(result, tmp_path):
    path = write_report([result], tmp_path / 'out', depth_images(result))
    html = path.read_text()
    outside = re.sub(r'base64,[A-Za-z0-9+/=]+', '', html)
    assert not re.search(r'https?://|<link|@import|url\(|src="(?!data:)', outside)
    assert '<odd>' not in html and '<&>' not in html, 'what users name is escaped'
    summary = result.summary()
    assert 'The truth is dashed' in html and '<th>mm, % of frames</th>' in html
    assert f'{summary["mean_mm"]:.3f}' in html and f'{100 * summary["within_mm"]["20"]:.2f}' in html
    assert {file.name for file in path.parent.iterdir()} == {'report.html', *(
        f'{name}.{form}' for name in ('curves', 'joints', 'errors', 'latency') for form in ('png', 'svg'))}
    for image in path.parent.glob('*.png'):
        assert cv2.imread(str(image)).std() > 10
    predict, total = (summary['latency_ms'][stage] for stage in ('predict', 'total'))
    assert tiles(html) == {
        'mean error': f'{summary["mean_mm"]:.1f} mm', 'median of joints': f'{summary["median_mm"]:.1f} mm',
        'frames within 40 mm': f'{100 * summary["within_mm"]["40"]:.1f} %',
        'area under the curve': f'{summary["auc_0_80"]:.3f}', 'hands found': '97.5 %', 'frames per second': '321',
        'latency, 99th percentile': f'{total["p99"]:.1f} ms', 'jitter': f'{summary["error_jitter_mm"]:.1f} mm'}
    cells = [f'{predict[key]:.2f}' for key in ('mean', 'p50', 'p90', 'p99', 'max')]
    fingers = [f'{mean:.1f}' for mean in metrics.per_finger_mm(result.errors_mm, HAND21).values()]
    assert ''.join(f'<th>{name}</th>' for name in ('mean error, mm', *FINGERS, 'palm')) in html
    for row in (['predict', *cells, f'{100 * predict["mean"] / total["mean"]:.0f} %'], ['model', 'm'],
                ['ours &lt;&amp;&gt; others', *fingers]):
        assert ''.join(f'<td>{cell}</td>' for cell in row) in html.replace(' class="text"', '')


def test_report_shows_the_best_median_and_worst_frame(result, tmp_path):
    html = write_report([result], tmp_path, depth_images(result)).read_text()
    means = metrics.frame_means_mm(result.errors_mm)
    order = [row for row in np.argsort(means) if np.isfinite(means[row])]
    titles = re.findall(r'<h3>(\w+): frame (\d+), ([\d.]+) mm</h3>', html)
    assert [(name, int(row) - 1) for name, row, _ in titles] == [
        ('Best', order[0]), ('Median', order[19]), ('Worst', order[-1])]
    views = json.loads(re.search(r'id="frames">(.*?)</script>', html)[1])['views']
    assert len(views) == 3 and all(len(view['cloud']) > 600 and len(view['estimate']) == 21 for view in views)
    assert all(np.mean(view['truth'], axis=0) == pytest.approx(0, abs=0.1) for view in views), 'the truth in the middle'
    assert all(max(map(abs, view['cloud'])) <= 150 and len(view['cloud']) < 3 * 5000 for view in views), 'of the hand'
    assert re.findall(r'data-view="(\d+)"', html) == ['0', '1', '2']
    for view in views:
        cloud = np.reshape(view['cloud'], (-1, 1, 3))
        assert np.linalg.norm(cloud - view['truth'], axis=-1).min(axis=0).max() < 5, 'the surface is at the joints'
    gap = np.linalg.norm(np.subtract(views[2]['estimate'], views[2]['truth']), axis=1).mean()
    assert gap == pytest.approx(means[order[-1]], abs=0.1), 'the view has the scale of the world'


def test_report_without_truth_shows_times_and_first_middle_last(result, tmp_path):
    blind = Result('b', HAND21, CAMERA, result.predictions, stamps_ns=result.stamps_ns, seconds=result.seconds,
                   hand_ids=np.repeat(['hand_1', 'hand_2'], 20))
    html = write_report([blind], tmp_path).read_text()
    assert re.findall(r'<h3>(\w+): frame (\d+)</h3>', html) == [('First', '1'), ('Middle', '21'), ('Last', '40')]
    assert 'Accuracy' not in html and 'The truth is dashed' not in html
    assert list(tiles(html)) == ['hands found', 'tracks', 'latency, 99th percentile', 'jitter']
    assert tiles(html)['tracks'] == '2'
    assert tiles(html)['jitter'] == f'{blind.summary()["jitter_mm"]:.1f} mm'
    live = replace(blind, seconds={'image to joints': blind.seconds['total']})  # the node tells no stages
    assert 'latency, 99th percentile' in tiles(write_report([live], tmp_path).read_text())


def test_notes_of_all_results_are_told(result, tmp_path):
    one, other = (replace(result, name=name, notes=(f'what to know of {name}',)) for name in ('one', 'other'))
    html = write_report([replace(one, info={'dataset': 'nyu'}), other], tmp_path).read_text()
    assert all(f'<td>{name}</td><td>{mean:g}</td>' in html for name, mean in DATASETS['nyu'].published)
    assert html.count('<td>other</td>') == 2, 'in the tables of accuracy and of fingers'
    assert write_report([one, replace(other, truth=None)], tmp_path).read_text().count('<td>other</td>') == 0
    assert 'one: what to know of one' in html and 'other: what to know of other' in html


def test_report_shows_a_frame_in_which_a_joint_is_unknown(result, tmp_path):
    truth, predictions = result.truth.copy(), result.predictions.copy()
    truth[:, 4], predictions[:, 8] = np.nan, np.nan
    lacking = replace(result, predictions=predictions)
    page = write_report([lacking], tmp_path, depth_images(result)).read_text()
    assert page.count('alt="joints on the depth image: truth"') == 3
    page = write_report([replace(lacking, truth=truth)], tmp_path, depth_images(result)).read_text()
    assert 'alt="joints on the depth image' not in page and page.count('<canvas data-view') == 3


def test_letters_that_no_font_has_are_no_warnings(result):
    with warnings.catch_warnings():
        warnings.filterwarnings('error', 'Glyph')  # other warnings depend on the versions of the libraries
        plots.to_bytes(plots.curves([replace(result, name='手')]), 'png')


def test_bones_of_two_hands_are_not_one_hand_that_changes(result):
    large = result.truth.copy()
    large[20:] = large[20:] * 1.2
    two = replace(result, predictions=large, truth=large)
    parts = replace(two, parts={'first': (0, 20), 'second': (20, 40)}).summary()
    tracks = replace(two, hand_ids=np.repeat(['hand_1', 'hand_2'], 20)).summary()
    assert two.summary()['bone_drift_mm'] > 1 > 0.01 > max(parts['bone_drift_mm'], tracks['bone_drift_mm'])


def test_report_of_nothing_found_can_be_written(result, tmp_path):
    nothing = Result('n', HAND21, CAMERA, np.full((3, 21, 3), np.nan), result.truth[:3],
                     seconds={'predict': np.full(3, np.nan), 'total': np.full(3, 0.001)})
    page = write_report([nothing], tmp_path).read_text()
    assert '<canvas data-view' not in page and '<td>nan</td>' not in page
    assert legends(plots.curves([nothing])) == [' n   AUC 0.000, mean -']


def test_tables_in_the_info_of_a_result_are_tables_of_the_report(result, tmp_path):
    info = {'model': 'm', 'files': ['a', 'b'], 'hidden_joints': {'joints': 850, 'mean_mm': 10.96674605},
            'frames_by_visible': [{'visible': [0, 7], 'mean_mm': 12.422}, {'visible': [8, 21], 'mean_mm': 7.588}]}
    page = write_report([replace(result, info=info)], tmp_path).read_text()
    for row in (('850', '10.967'), ('0 to 7', '12.422'), ('8 to 21', '7.588')):
        assert '<tr>' + ''.join(f'<td>{cell}</td>' for cell in row) + '</tr>' in page
    assert 'hidden joints:' in page and '<th>visible</th><th>mean_mm</th>' in page
    assert 'files</td><td class="text">[' in page and '850, ' not in page
    assert 'More numbers' not in write_report([result], tmp_path).read_text()


def test_report_of_no_frames_can_be_written(result, tmp_path):
    none = replace(result, predictions=result.predictions[:0], truth=result.truth[:0], stamps_ns=result.stamps_ns[:0],
                   seconds={stage: seconds[:0] for stage, seconds in result.seconds.items()})
    for one in none, replace(none, truth=None):
        page = write_report([one], tmp_path).read_text()
        assert '0 frames' in page and '<td>nan</td>' not in page


def test_curves_show_what_the_metrics_say(result):
    left, right = plots.curves([result]).axes
    for axes, curve in ((left, metrics.success_curve), (right, metrics.pck)):
        line = axes.lines[0]
        assert line.get_ydata() == pytest.approx(100 * curve(result.errors_mm, line.get_xdata()))
        assert (axes.get_xlim(), axes.get_ylim()) == ((0, 80), (0, 100))
    assert (left.get_title('left'), left.get_ylabel()) == ('Frames with all joints within', 'frames, %')
    assert (right.get_title('left'), right.get_ylabel()) == ('Joints within', 'joints, %')
    auc, mean = metrics.auc(result.errors_mm), metrics.mean_mm(result.errors_mm)
    assert len({plots.to_bytes(plots.curves([result]), 'svg') for _ in range(2)}) == 1, 'so that git sees no change'
    assert legends(plots.curves([result])) == [f' {result.name}   AUC {auc:.3f}, mean {mean:.1f} mm']
    (axes,) = plots.joint_bars([result, replace(result, predictions=result.truth)]).axes
    assert [label.get_text().replace(' ', '_') for label in axes.get_xticklabels()] == list(HAND21.joint_names)
    bars = axes.patches
    assert [bar.get_height() for bar in bars] == pytest.approx([*metrics.per_joint_mm(result.errors_mm), *[0] * 21])
    assert [bar.get_center()[0] for bar in bars] == pytest.approx([*(np.arange(21) - 0.2), *(np.arange(21) + 0.2)])


def test_errors_and_times_are_drawn_where_they_were(result):
    seconds = {**result.seconds, 'decode': np.full(40, np.nan)}  # a stage that did not run
    parted = replace(result, parts={'first': (0, 20), 'second': (20, 40)}, seconds=seconds,
                     stamps_ns=result.stamps_ns + 10 ** 18)
    at, errors = 0.033 * np.arange(40), result.errors_mm
    (axes,) = plots.over_time(parted).axes
    lines = {line.get_label(): line.get_xydata().T for line in axes.lines}
    assert len({line.get_color() for line in axes.lines[:3]}) == 3, 'mean, worst and missed can be told apart'
    for label, expected in (('mean of joints', metrics.frame_means_mm(errors)), ('worst joint', errors.max(axis=1))):
        np.testing.assert_allclose(lines[label], [at, np.where(np.arange(40) == 7, np.nan, expected)])
    assert lines['missed'][0] == pytest.approx(at[7:8]) and axes.get_ylim()[1] > errors[np.isfinite(errors)].max()
    assert axes.get_title('left') == 'Error of each frame', 'true also of frames that do not follow each other'
    assert [text.get_text() for text in axes.texts] == ['first', 'second']
    starts = [text.xy[0] for text in axes.texts]
    assert starts == [line.get_xdata()[0] for line in axes.lines[-2:]] == pytest.approx(at[[0, 20]])
    (axes,) = plots.latency(parted).axes
    tops = [area.get_paths()[0].vertices[:, 1].max() for area in axes.collections]
    assert tops == pytest.approx([1000 * seconds['predict'].max()] * 2) and axes.get_xlabel() == 'time, s'
    assert legends(axes.figure) == ['predict', 'decode'] and axes.get_ylim()[1] > tops[1]


def test_the_times_of_a_long_recording_are_drawn_as_means(result):
    """A bar for each frame would be thinner than a pixel, and the report of an hour would have 80 MB."""
    seconds = np.random.default_rng(0).exponential(0.01, 18_000)
    long = replace(result, predictions=np.zeros((18_000, 21, 3)), truth=None, stamps_ns=33_000_000 * np.arange(18_000),
                   seconds={'read': seconds / 2, 'predict': seconds})
    figure = plots.latency(long)
    (axes,) = figure.axes
    assert len(plots.to_bytes(figure, 'svg')) < 500_000 and axes.get_title('left').endswith('(mean of 23)')
    means = 1500 * seconds[:17_986].reshape(-1, 23).mean(1)
    assert axes.collections[1].get_paths()[0].vertices[:, 1].max() == pytest.approx(means.max())
    assert axes.get_xlim() == pytest.approx((0, 594), abs=1)


def test_frames_that_took_no_time_that_is_known_are_drawn(result):
    with warnings.catch_warnings():
        warnings.filterwarnings('error', 'Attempting to set')
        plots.latency(replace(result, seconds={'image to joints': np.full(40, np.nan)}))  # the node answered none


def test_labels_scored_as_predictions_are_drawn_at_zero(result):
    (axes,) = plots.over_time(replace(result, predictions=result.truth)).axes
    assert axes.get_ylim()[0] == 0


def test_mean_errors_are_in_view_where_every_frame_lacks_a_joint(result):
    predictions = result.predictions.copy()
    predictions[:, 4] = np.nan
    lacking = replace(result, predictions=predictions)
    (axes,) = plots.over_time(lacking).axes
    means = metrics.frame_means_mm(lacking.errors_mm)
    assert axes.get_ylim()[1] > means[np.isfinite(means)].max()


@pytest.mark.parametrize('stamps', [np.zeros(40, int), np.arange(40) % 20], ids=['all 0', 'of a loop'])
def test_images_without_a_time_of_their_own_are_drawn_in_order(result, stamps):
    odd = replace(result, stamps_ns=stamps)
    for axes in plots.over_time(odd).axes + plots.latency(odd).axes:
        assert axes.get_xlim() == (1, 40) and axes.get_xlabel() == 'frame'


def test_the_time_of_a_single_image_is_drawn(result, tmp_path):
    one = replace(result, predictions=result.predictions[:1], truth=result.truth[:1], stamps_ns=result.stamps_ns[:1],
                  seconds={stage: seconds[:1] for stage, seconds in result.seconds.items()})
    image = cv2.imdecode(np.frombuffer(plots.to_bytes(plots.latency(one), 'png'), np.uint8), 1)
    assert (np.abs(image.astype(int) - [178, 114, 0]).max(-1) < 40).mean() > 0.4
    write_report([one], tmp_path)
    assert not (tmp_path / 'errors.svg').exists(), 'one frame is no line over time'


@pytest.mark.parametrize('frames', [200, 2000])
def test_errors_over_time_show_labels_of_some_images_only(result, frames):
    rows = np.arange(frames) * 40 // frames
    truth = np.where((np.arange(frames) % 10 == 0)[:, None, None], result.truth[rows], np.nan)
    some = replace(result, predictions=result.predictions[rows], truth=truth, stamps_ns=33_000_000 * np.arange(frames))
    image = cv2.imdecode(np.frombuffer(plots.to_bytes(plots.over_time(some), 'png'), np.uint8), 1)
    plot = image[image.shape[0] // 4:]  # without the legend
    assert (np.abs(plot.astype(int) - [178, 114, 0]).max(-1) < 40).sum() > 100


def test_errors_of_a_long_recording_are_drawn_as_median_and_range(result):
    errors = np.random.default_rng(0).uniform(0, 50, 2000)
    truth = np.broadcast_to(result.truth[0], (2000, 21, 3))
    predictions = truth + errors[:, None, None] / 1000 * [1, 0, 0]
    long = replace(result, predictions=predictions, truth=truth, stamps_ns=33_000_000 * np.arange(2000))
    (axes,) = plots.over_time(long).axes
    assert legends(axes.figure) == [f'{name} (median, range of 3)' for name in ('worst joint', 'mean of joints')]
    threes = errors[:1998].reshape(-1, 3)
    for line, area in zip(axes.lines, axes.collections, strict=True):
        np.testing.assert_allclose(line.get_xydata().T, [0.033 * (1 + 3 * np.arange(666)), np.median(threes, axis=1)])
        drawn = area.get_paths()[0].vertices[:, 1]
        assert np.isin(np.round([threes.min(1), threes.max(1)], 6), np.round(drawn, 6)).all()


def test_any_name_of_a_result_can_be_drawn(result, tmp_path):
    odd = [replace(result, name=name) for name in ('costs $1_{ to $2', '100 %', '_old')]
    write_report(odd, tmp_path)
    for figure in plots.curves(odd), plots.joint_bars(odd):
        assert all(any(one.name in entry for entry in legends(figure)) for one in odd)


def test_times_beside_those_of_the_paper_have_numbers_at_their_axis():
    figure = runtime({'deep|eager': {'p50_ms': 40.0}, 'deep|fast': {'p50_ms': 0.2}}, {'deep': (0.1, 2.0)})
    figure.draw_without_rendering()
    assert {'1', '10'} <= {label.get_text() for label in figure.axes[0].get_yticklabels()}


def test_many_results_with_long_names_can_be_told_apart(result):
    many = [replace(result, name=f'{k % 5} of {"many " * 40}: {k // 5}') for k in range(20)]
    for figure in plots.curves(many), plots.joint_bars(many):
        figure.draw_without_rendering()
        assert len(set(legends(figure))) == 20
        (legend,) = figure.findobj(Legend)
        inside = legend.get_window_extent()
        assert figure.bbox.containsx(inside.x0) and figure.bbox.containsx(inside.x1)
        assert figure.bbox.containsy(inside.y0) and figure.bbox.containsy(inside.y1)
        for axes in figure.axes:
            around = axes.get_tightbbox()
            assert not around.overlaps(inside) and around.height > figure.bbox.height / 5, 'no curve is covered'
    lines = plots.curves(many).axes[0].lines
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 20
    bars = [bar[0] for bar in plots.joint_bars(many).axes[0].containers]
    assert len({(bar.get_facecolor(), bar.get_hatch()) for bar in bars}) == 20


def tiles(html):
    """What the tiles at the head of a report say."""
    return {label: value for value, label in re.findall(r'<b>([^<]*)</b><span class="soft">([^<]*)</span>', html)}


def legends(figure):
    """What the legends of a figure say, entry by entry."""
    return [text.get_text() for legend in figure.findobj(Legend) for text in legend.get_texts()]


@pytest.fixture(scope='session')
def chromium():
    found = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), None)
    if found is None:
        pytest.skip('no chromium on this machine: apt-get install chromium')

    def run(*arguments, profile):
        return subprocess.run(
            [found, '--headless', '--no-sandbox', '--disable-gpu', '--disable-background-networking',
             '--disable-dev-shm-usage', '--hide-scrollbars', '--no-first-run', f'--user-data-dir={profile}',
             '--virtual-time-budget=3000', *arguments], capture_output=True, text=True, timeout=90, check=True).stdout
    return run


def test_a_browser_shows_the_report_and_turns_the_hands(result, tmp_path, chromium):
    path = write_report([result], tmp_path / 'out', depth_images(result))
    # What a user does, and what then is on the screen, told by the title.
    probe = """<script>
      const canvas = document.querySelector('canvas'), before = canvas.toDataURL(), images = [...document.images];
      canvas.dispatchEvent(new PointerEvent('pointermove', {movementX: 60, movementY: 10, buttons: 1}));
      const turned = canvas.toDataURL();
      canvas.dispatchEvent(new MouseEvent('dblclick'));
      document.title = JSON.stringify({turned: turned !== before, back: canvas.toDataURL() === before,
        loaded: images.every(image => image.complete && image.naturalWidth > 100), images: images.length,
        wide: document.documentElement.scrollWidth > window.innerWidth});
    </script></body>"""
    probed = tmp_path / 'probed.html'
    probed.write_text(path.read_text().replace('</body>', probe))
    dom = chromium('--dump-dom', '--window-size=1200,3000', f'file://{probed}', profile=tmp_path / 'a')
    assert json.loads(re.search(r'<title>(.*?)</title>', dom)[1]) == {
        'turned': True, 'back': True, 'loaded': True, 'images': 7, 'wide': False}

    chromium(f'--screenshot={tmp_path / "page.png"}', '--window-size=1200,4200', f'file://{path}',
             profile=tmp_path / 'b')
    page = cv2.imread(str(tmp_path / 'page.png'))
    for bgr in ([178, 114, 0], [80, 92, 255], [24, 29, 20]):  # the curve, the thumb, the ground of a 3D view
        assert (np.abs(page.astype(int) - bgr).max(-1) < 12).sum() > 200, f'no {bgr} on the page'


def test_a_browser_shows_an_estimate_however_far_before_the_truth(result, tmp_path, chromium):
    predictions = result.truth.copy()
    predictions[3, :, 2] -= 0.9  # it fits no view, and is the worst
    path = write_report([replace(result, predictions=predictions)], tmp_path / 'out')
    probe = """<script>
      const canvas = [...document.querySelectorAll('canvas')].pop();
      const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      let thumb = 0;
      for (let k = 0; k < data.length; k += 4) thumb += data[k] > 240 && data[k + 1] < 110 && data[k + 2] < 100;
      document.title = thumb;
    </script></body>"""
    path.write_text(path.read_text().replace('</body>', probe))
    dom = chromium('--dump-dom', '--window-size=1200,3000', f'file://{path}', profile=tmp_path / 'a')
    assert int(re.search(r'<title>(\d+)</title>', dom)[1]) > 10


def test_compare_prints_tables_and_intervals(result, tmp_path, capsys):
    better = Result('better', HAND21, CAMERA, (result.predictions + result.truth) / 2, result.truth)
    result.save(tmp_path / 'a.npz')
    better.save(tmp_path / 'b.npz')
    assert main(['compare', f'first={tmp_path / "a.npz"}', str(tmp_path / 'b.npz'), '--json', str(tmp_path / 'c.json'),
                 '--out', str(tmp_path / 'plots'), '--block', '1']) == 0
    printed = capsys.readouterr().out
    assert 'better - first: -' in printed and '95 % interval' in printed
    got = json.loads((tmp_path / 'c.json').read_text())
    half = got['results'][0]['mean_mm'] / 2
    assert got['differences'][0]['mean_mm'] == pytest.approx(-half, rel=1e-6)
    low, high = got['differences'][0]['interval_mm']
    assert low < -half < high < 0, 'certainly better'
    assert (tmp_path / 'plots' / 'curves.svg').is_file()
    assert main(['compare', str(tmp_path / 'a.npz'), str(tmp_path / 'b.npz'), '--block', '10', '--json',
                 str(tmp_path / 'c.json')]) == 0
    wide = json.loads((tmp_path / 'c.json').read_text())['differences'][0]['interval_mm']
    assert np.ptp(wide) > 1.2 * (high - low), 'neighbours that err alike are less to go by'
    replace(better, name=result.name).save(tmp_path / 'b.npz')  # two results of one bag have its name
    assert main(['compare', str(tmp_path / 'a.npz'), str(tmp_path / 'b.npz'), '--block', '1']) == 0
    assert 'b - a: -' in capsys.readouterr().out


def test_results_of_one_bag_are_told_apart_everywhere(result, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    worse = replace(result, predictions=result.predictions + 0.05)
    for name, one in (('day1/r.npz', result), ('day2/r.npz', worse), ('r.npz', worse)):
        one.save(name)
    assert main(['compare', 'day1/r.npz', 'day2/r.npz', '--out', 'both']) == 0
    assert 'day2/r - day1/r: +' in capsys.readouterr().out
    page = (tmp_path / 'both' / 'report.html').read_text()
    rows = re.findall(r'<tr><td>day(\d)/r</td><td>([\d.]+)</td>', page[page.index('Which joints are hard'):])
    assert [name for name, _ in rows] == ['1', '2'] and float(rows[1][1]) > float(rows[0][1]) + 20
    assert [one.name for one in named_apart([result, worse, worse], ['', 'r.npz', 'r.npz'])] == [
        result.name, 'r', 'r (2)']
    given = [one.name for one in named_apart([result, worse], ['x=r.npz', 'x=r.npz'])]
    assert given == [result.name, f'{result.name} (2)']


def test_what_is_compared_is_not_written_over(result, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ('a.npz', 'x=1.npz'):
        result.save(name)
    before = (tmp_path / 'a.npz').read_bytes()
    assert main(['compare', 'x=1.npz', 'old=a.npz', '--json', 'a.npz']) == 1
    assert main(['compare', 'x=1.npz', 'old=a.npz', '--json', str(tmp_path)]) == 1
    assert main(['evaluate', 'bag.mcap', '--out', 'x=1.npz', '--compare', 'old=x=1.npz']) == 1
    kept, folder, kept_too = capsys.readouterr().err.splitlines()
    assert 'a.npz: this is the input, which would be lost' in kept and 'is a folder' in folder
    assert 'x=1.npz: this is the input, which would be lost' in kept_too
    assert before == (tmp_path / 'a.npz').read_bytes() == (tmp_path / 'x=1.npz').read_bytes()
    assert main(['compare', 'x=1.npz', 'old=a.npz', '--json', 'c.json']) == 0
    assert [one['name'] for one in json.loads((tmp_path / 'c.json').read_text())['results']] == [result.name, 'old']
    assert main(['compare', 'x=1.npz', 'a.npz']) == 0
    assert 'a - x=1: +0.000 mm' in capsys.readouterr().out


def test_compare_refuses_what_cannot_be_compared(result, tmp_path, capsys):
    result.save(tmp_path / 'a.npz')
    Result('short', HAND21, CAMERA, result.predictions[:9], result.truth[:9]).save(tmp_path / 'short.npz')
    Result('blind', HAND21, CAMERA, result.predictions).save(tmp_path / 'blind.npz')
    a, short, blind = (str(tmp_path / f'{name}.npz') for name in ('a', 'short', 'blind'))
    assert main(['compare', a, short]) == 0
    assert f'short and {result.name} have 9 and 40 frames: no interval' in capsys.readouterr().err
    replace(result, truth=result.truth + 0.01).save(tmp_path / 'other.npz')
    assert main(['compare', a, str(tmp_path / 'other.npz')]) == 0
    assert 'were evaluated on different truth: no interval' in capsys.readouterr().err
    Result('14', get_skeleton('nyu14'), CAMERA, result.predictions[:, :14], result.truth[:, :14]).save(
        tmp_path / '14.npz')
    assert main(['compare', a, str(tmp_path / '14.npz'), '--out', str(tmp_path / 'plots')]) == 1
    said = capsys.readouterr().err
    assert 'have different joints: no interval' in said and 'joints cannot be drawn into one picture' in said
    partly = np.where(np.arange(40)[:, None, None] < 30, result.truth, np.nan)
    for name in 'one', 'two':
        replace(result, name=name, truth=partly).save(tmp_path / f'{name}.npz')
    assert main(['compare', *(str(tmp_path / f'{name}.npz') for name in ('one', 'two'))]) == 0
    assert 'two - one: +0.000 mm, 95 % interval' in capsys.readouterr().out, 'some images have no labels'
    replace(result, predictions=np.full_like(result.predictions, np.nan)).save(tmp_path / 'lost.npz')
    assert main(['compare', a, str(tmp_path / 'lost.npz'), '--json', str(tmp_path / 'c.json')]) == 0
    assert 'have fewer than two frames with a hand in common' in capsys.readouterr().err
    assert len(json.loads((tmp_path / 'c.json').read_text())['results']) == 2
    assert main(['compare', a, blind]) == 1
    assert 'blind has no ground truth' in capsys.readouterr().err
    assert main(['compare', a, str(tmp_path / 'predictions.txt')]) == 1
    assert 'predictions.txt: there is no such file' in capsys.readouterr().err
    (tmp_path / 'predictions.txt').touch()
    for half in ([], ['--dataset', 'nyu'], ['--ground-truth', str(tmp_path / 'predictions.txt')]):
        assert main(['compare', a, str(tmp_path / 'predictions.txt'), *half]) == 1
        assert 'need --ground-truth and --dataset' in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        main(['compare', a])
    assert caught.value.code == 2
