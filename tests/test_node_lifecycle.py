"""What the node promises about its states, its parameters and its command: the real node, over real DDS."""

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from test_node import Rig, camera_info, depth_with_hand, image, rig  # noqa: F401 (fixtures)
from visualization_msgs.msg import Marker, MarkerArray

from hand_pose_ros.cli import main
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import shutdown
from hand_pose_ros.ros.node import EstimatorNode

pytestmark = pytest.mark.usefixtures('ros_domain', 'load_once')

COMMAND = [sys.executable, '-m', 'hand_pose_ros.cli']


def test_each_state_has_what_it_needs_and_no_more(rig: Rig) -> None:
    node = rig.start(autostart=False)
    assert rig.state() == 'unconfigured'
    assert rig.client.count_publishers('/hand/joints') == 0
    assert rig.transition('configure') and rig.state() == 'inactive'
    assert not rig.call(SetBool, 'enable', data=True).success
    for _ in range(2):
        assert rig.transition('activate')
        publish = rig.camera(info=camera_info())
        rig.answer(publish, image(depth_with_hand()))
        assert rig.transition('deactivate') and rig.state() == 'inactive'
        assert rig.client.count_subscribers('/depth/image_rect') == 0
    estimator = weakref.ref(node._estimator)
    assert rig.transition('cleanup') and rig.state() == 'unconfigured'
    assert estimator() is None, 'the network must be gone after cleanup'
    assert rig.transition('configure') and rig.transition('activate')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands
    assert rig.transition('shutdown') and rig.state() == 'finalized'


def test_a_transition_out_of_place_is_refused(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    node = rig.start()
    monkeypatch.setattr(node, '_LifecycleNodeMixin__change_state',  # up to Jazzy rclpy raises what this does
                        lambda number: node._state_machine.trigger_transition_by_id(number, True))
    assert not rig.call(ChangeState, 'change_state', transition=Transition(id=Transition.TRANSITION_ACTIVATE)).success
    rig.until_said('there is no transition 3 from the state active', 'ros2 lifecycle list /estimator')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def test_unknown_weights_are_named_and_can_be_corrected(rig: Rig) -> None:
    rig.start(model='/nowhere/weights.safetensors')
    assert rig.state() == 'unconfigured'
    rig.until_said('/nowhere/weights.safetensors')
    rig.until_said('the node does nothing')
    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and reports[-1].status[0].level == b'\x02', 'an error')
    assert '/nowhere/weights.safetensors' in reports[-1].status[0].message
    assert rig.set_parameter('model', str(rig.weights))[0]
    assert rig.transition('configure') and rig.transition('activate')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands
    rig.until(lambda: reports[-1].status[0].level == b'\x00', 'the error to be gone')


def test_a_disabled_node_shows_nothing_and_reset_forgets_hands(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    first = rig.answer(publish, image(depth_with_hand(), 1)).hands[0].id
    assert rig.answer(publish, image(depth_with_hand(), 2)).hands[0].id == first
    assert rig.call(Trigger, 'reset').success
    second = rig.answer(publish, image(depth_with_hand(), 3)).hands[0].id
    assert second != first

    assert rig.call(SetBool, 'enable', data=False).message == 'disabled'
    rig.until(lambda: rig.client.count_subscribers('/depth/image_rect') == 0)
    rig.until(lambda: {(m.ns.split('/')[0], m.action) for m in rig.received[MarkerArray][-1].markers}
              == {(second, Marker.DELETE)}, 'deletions')
    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and reports[-1].status[0].message == 'the node is disabled', 'diagnostics')
    assert rig.call(SetBool, 'enable', data=True).success
    hand, = rig.answer(rig.camera(), image(depth_with_hand(), 4)).hands  # the camera_info is known already
    assert hand.id not in (first, second)  # somebody else may be there by now


def test_parameters_change_between_images_or_are_refused_with_the_reason(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    assert len(rig.answer(publish, image(depth_with_hand())).hands) == 1
    assert rig.set_parameter('max_depth', 0.5)[0]
    assert len(rig.answer(publish, image(depth_with_hand())).hands) == 0
    assert rig.set_parameter('depth_scale', 0.0005)[0]  # the same numbers, half as far away
    hand, = rig.answer(publish, image(depth_with_hand())).hands
    assert hand.cube_center.z == pytest.approx(0.3, abs=0.1)
    assert rig.set_parameter('cube_size', 0.25)[0]
    assert rig.answer(publish, image(depth_with_hand())).hands[0].cube_size == pytest.approx(0.25)
    assert rig.set_parameter('cube_size', 0.0)[0]
    assert rig.answer(publish, image(depth_with_hand())).hands[0].cube_size == pytest.approx(0.3)

    for name, value, reason in (('depth_scale', 2.0, 'range'), ('depth_scale', -1.0, 'range'), ('side', 'both', 'auto'),
                                ('min_depth', 5.0, 'max_depth'), ('model', 'other', 'configured'),
                                ('device', 'cuda', 'configured'), ('autostart', False, 'read'),
                                ('max_hands', 0, 'range'), ('min_score', 'high', 'type')):
        done, why = rig.set_parameter(name, value)
        assert not done and reason in why.lower(), (name, why)
    assert rig.answer(publish, image(depth_with_hand())).hands


def test_a_parameter_that_there_is_not_is_named(rig: Rig) -> None:
    rig.start(max_depht=1.0)
    rig.until_said("no parameter 'max_depht'", 'no effect')


@pytest.mark.parametrize('arguments', [('estimator',), ('replay', 'demo/hand.mcap'),
                                       ('evaluate', 'demo/hand.mcap', '--via-ros')])
def test_a_log_of_ros_that_cannot_be_written_is_told_with_the_remedy(arguments: tuple[str, ...]) -> None:
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, cwd=Path(__file__).parents[1],
                          env=os.environ | {'ROS_LOG_DIR': '/proc/log'})
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert f'hand-pose {arguments[0]}: ROS cannot write its log' in done.stderr and 'ROS_LOG_DIR' in done.stderr


@pytest.mark.parametrize('arguments', [('--params-file', '/nowhere.yaml'), ('-r', 'depth/image_rect')])
def test_arguments_that_ros_cannot_read_are_one_sentence(arguments: tuple[str, ...],
                                                         capfd: pytest.CaptureFixture[str]) -> None:
    assert main(['estimator', '--ros-args', *arguments]) == 1
    said = capfd.readouterr().err
    assert 'the arguments of ROS cannot be used' in said and '.c:' not in said.rpartition('cannot be used')[2]


@pytest.mark.parametrize(('value', 'sentence'), [
    ('min_score:=1', 'parameter min_score is 1: give a number with a point, as 1.0, from 0 to 1'),
    ('min_score:=1.5', 'parameter min_score is 1.5: give a number with a point, as 1.0, from 0 to 1'),
    ('max_hands:=two', "parameter max_hands is 'two': give a whole number from 1 to 8"),
    ('tracking:=1', 'parameter tracking is 1: give true or false')])
def test_a_parameter_of_another_kind_is_one_sentence(value: str, sentence: str,
                                                     capfd: pytest.CaptureFixture[str]) -> None:
    assert main(['estimator', '--ros-args', '-p', value]) == 1
    assert sentence in capfd.readouterr().err


def test_many_activations_leave_nothing_behind(rig: Rig) -> None:
    node = rig.start()
    threads = threading.active_count()
    for _ in range(30):
        assert rig.transition('deactivate') and rig.transition('activate')
    assert len(list(node.subscriptions)) == 2
    assert threading.active_count() == threads
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def test_the_command_starts_and_ends_cleanly(rig: Rig) -> None:
    process = subprocess.Popen(
        [*COMMAND, 'estimator', '--ros-args', '-p', f'model:={rig.weights}',
         '-p', 'min_score:=0.0'], stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        rig.until(lambda: rig.client.count_publishers('/hand/joints'), 'the node', seconds=90)
        publish = rig.camera(info=camera_info())
        while not rig.received[HandJointsArray]:
            publish(image(depth_with_hand()))
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    assert 'Traceback' not in errors


def test_the_node_ends_while_rclpy_shuts_down(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-C, a thread of rclpy shuts down, too. Neither may end in a traceback."""
    context = rclpy.Context()
    context.init()
    node = EstimatorNode(context=context, parameter_overrides=[
        Parameter('model', value=str(weights)), Parameter('autostart', value=False)])
    node.trigger_configure()
    node.trigger_activate()
    clear = node._outputs.clear

    def late(header: object) -> None:
        context.shutdown()
        clear(header)

    monkeypatch.setattr(node._outputs, 'clear', late)
    node.destroy_node()
    assert not context.ok()
    monkeypatch.setattr(rclpy, 'try_shutdown', context.shutdown)
    with pytest.raises(RuntimeError):
        rclpy.try_shutdown()
    shutdown()
