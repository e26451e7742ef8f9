"""What the documentation says is true: links lead somewhere, tables are those of the code, commands and code work."""

import importlib
import os
import re
import shlex
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path

import pytest

from hand_pose_ros.cli import VERBS
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.skeleton import SKELETONS

CHECKOUT = Path(__file__).resolve().parents[1]
README = CHECKOUT / 'README.md'
PAGES = [*sorted(CHECKOUT.glob('*.md')), *sorted((CHECKOUT / 'docs').glob('*.md'))]
TEXTS = {str(page.relative_to(CHECKOUT)): page.read_text() for page in PAGES}


def prose(text: str) -> str:
    """Without blocks of code."""
    return re.sub(r'^```.*?^```', '', text, flags=re.DOTALL | re.MULTILINE)


def anchors(text: str) -> set[str]:
    titles = re.findall(r'^#+ (.+)$', prose(text), flags=re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-') for title in titles}


def rows(text: str, header: str) -> list[list[str]]:
    """The cells of the table under this header, without backquotes."""
    table = text.split(header, 1)[1].split('\n\n', 1)[0].strip().splitlines()[1:]
    return [[cell.strip().replace('`', '') for cell in line.strip('|').split('|')] for line in table]


@pytest.mark.parametrize('name', TEXTS)
def test_links_lead_somewhere(name: str) -> None:
    links = re.findall(r'\]\(([^)\s]+)\)', prose(TEXTS[name]))
    for link in links:
        if link.startswith(('http://', 'https://')):
            continue
        path, _, anchor = link.partition('#')
        target = (CHECKOUT / name).parent / path if path else CHECKOUT / name
        assert target.exists(), f'{name} links to {link}, which does not exist'
        if anchor:
            assert anchor in anchors(target.read_text()), f'{name} links to {link}, and there is no such title'


@pytest.mark.parametrize('name', TEXTS)
def test_no_number_is_still_to_be_filled_in(name: str) -> None:
    assert re.findall(r'\{\{.*?\}\}', TEXTS[name]) == []


@pytest.mark.parametrize('name', TEXTS)
def test_files_that_are_named_exist(name: str) -> None:
    named = set(re.findall(r'`(?!NAME)((?:[\w.]+/)*\w+\.(?:py|yaml|xml|msg|md))`', TEXTS[name]))
    parts = [CHECKOUT, CHECKOUT / 'hand_pose_ros', CHECKOUT / 'docs']
    assert [file for file in sorted(named) if not any((part / file).exists() for part in parts)] == []


def commands() -> dict[str, list[str]]:
    """All command lines with hand-pose in blocks of code, by the page and the line itself."""
    found = {}
    for name, text in TEXTS.items():
        code = re.sub(r'\\\n\s*', ' ', text)
        code = '\n'.join(re.findall(r'^```\w*\n(.*?)^```', code, re.DOTALL | re.MULTILINE)
                         + re.findall(r'^(?: {4}|\t)(.+)$', code, re.MULTILINE))
        for line in re.findall(r'^(?:\S+ )*?(?:\.venv/bin/)?hand-pose (.+)$', code, re.MULTILINE):
            found[f'{name}: {line}'] = shlex.split(line, comments=True)
    return found


COMMANDS = commands()


@pytest.mark.parametrize('line', COMMANDS)
def test_commands_have_the_options_that_pages_give_them(line: str) -> None:
    verb, *arguments = COMMANDS[line]
    assert verb in VERBS
    parser = ArgumentParser()
    importlib.import_module(f'hand_pose_ros.cli.{verb}').add_arguments(parser)
    parser.parse_args(arguments)  # exits if it does not know one


def test_the_pages_have_commands() -> None:
    assert len(COMMANDS) > 20


def test_table_of_parameters_is_that_of_the_node() -> None:
    pytest.importorskip('rclpy', reason='needs ROS 2')
    from hand_pose_ros.ros.params import markdown_table
    shown = re.search(r'<!-- parameters: begin -->\n(.*?)\n<!-- parameters: end -->', README.read_text(), re.DOTALL)
    assert shown is not None
    assert shown[1] == markdown_table(), 'put the output of `hand-pose estimator --parameters` into README.md'


def test_table_of_topics_is_that_of_the_node(ros_domain: int, weights: Path) -> None:
    rclpy = pytest.importorskip('rclpy', reason='needs ROS 2')
    pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')
    from rclpy.parameter import Parameter

    from hand_pose_ros.ros.node import EstimatorNode
    options = {'model': str(weights), 'detector': 'region', 'publish_poses': True, 'publish_joint_states': True}
    rclpy.init()
    node = EstimatorNode(parameter_overrides=[Parameter(name, value=value) for name, value in options.items()])
    try:
        me = node.get_name(), node.get_namespace()
        found = [*node.get_publisher_names_and_types_by_node(*me), *node.get_subscriber_names_and_types_by_node(*me)]
        services = dict(node.get_service_names_and_types_by_node(*me))
    finally:
        node.destroy_node()
        rclpy.shutdown()
    own = {name: types[0].replace('/msg/', '/') for name, types in found
           if not name.endswith(('/rosout', '/parameter_events', '/transition_event', '/clock'))}
    shown = {row[0]: row[1] for row in rows(README.read_text(), '| topic | type | |')}
    shown.pop('/tf')  # its type is not installed with every ROS
    assert {name.replace('~', '/estimator') if name[0] in '/~' else f'/{name}': kind
            for name, kind in shown.items()} == own
    assert services['/estimator/enable'] == ['std_srvs/srv/SetBool']
    assert services['/estimator/reset'] == ['std_srvs/srv/Trigger']


def test_parameters_of_networks_are_counted() -> None:
    shown = dict(rows(TEXTS['docs/paper.md'], '| network, 21 joints | parameters |'))
    header = '| | `hand_dense` (default) | `deep_prior` |'
    (models,) = (row[1:] for row in rows(TEXTS['docs/models.md'], header) if row[0] == 'parameters')
    sizes = {network: sum(weights.numel() for weights in build(network).parameters()) for network in shown}
    assert {network: f'{size:,}' for network, size in sizes.items()} == shown
    shipped = [load_checkpoint(name) for name in ('hand_dense', 'deep_prior', 'deep_prior_orref')]
    assert models == [f'{sum(part.numel() for net in (c.network, c.refiner) if net for part in net.parameters()):,}'
                      for c in shipped]


def test_skeletons_are_those_of_the_code() -> None:
    shown = {row[0]: row[1].split()[0].rstrip(',') for row in rows(TEXTS['docs/concepts.md'],
                                                                   '| skeleton | joints | from |')}
    assert shown == {name: str(len(skeleton)) for name, skeleton in SKELETONS.items()}


def test_documentation_builds_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip('mkdocs', reason="needs mkdocs-material: pip install '.[docs]'")
    done = subprocess.run([sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', tmp_path], cwd=CHECKOUT,
                          env=os.environ | {'NO_MKDOCS_2_WARNING': '1'}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'concepts' / 'index.html').is_file()
