"""ONNX Runtime on the CPU: the same graph without Python between its operations. It is three to five times faster."""

from __future__ import annotations

import inspect
import time
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.runtime.engine import Array, Engine, Pipeline

OPSET = 17
WORTH_THREADS = 1.1
"""More threads are used only if they make a network faster by this factor. They wake slowly, and other programs need
them, too."""


def export(pipeline: Pipeline) -> bytes:
    """The pipeline as an ONNX model for any number of patches."""
    example = torch.zeros(2, 1, PATCH_SIZE, PATCH_SIZE)
    return to_onnx(pipeline, example, 'patches', {name: {0: 'batch'} for name in ('patches', *pipeline.outputs)})


def to_onnx(module: nn.Module, example: Tensor, name: str, axes: dict[str, dict[int, str]]) -> bytes:
    """A module with one input `name` as an ONNX model. `axes` names the free dimensions of the input, then of all
    outputs.

    It uses the exporter that traces: every supported release of PyTorch has it, and it needs no onnxscript.
    """
    # Releases before 2.5 have no other exporter, and do not know the argument that chooses it.
    choice: dict[str, Any] = {'dynamo': False} if 'dynamo' in inspect.signature(torch.onnx.export).parameters else {}
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter('ignore')
        path = Path(folder) / 'network.onnx'
        torch.onnx.export(module, (example,), str(path), opset_version=OPSET, input_names=[name],
                          output_names=[output for output in axes if output != name], dynamic_axes=axes, **choice)
        return path.read_bytes()


def open_session(model: bytes, num_threads: int, batch: int | None = None) -> onnxruntime.InferenceSession:
    """A session on `num_threads` CPU threads, including the caller's. `batch` fixes the batch size; None = any."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = num_threads
    options.inter_op_num_threads = 1
    # Threads that spin between images would take whole cores from the rest of the robot. Where cores are shared, they
    # also slow down the network itself: see docs/performance.md.
    options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    # Errors come as exceptions. Warnings about the graph do not help the user.
    options.log_severity_level = 3
    if batch is not None:
        options.add_free_dimension_override_by_name('batch', batch)
    return onnxruntime.InferenceSession(model, options, providers=['CPUExecutionProvider'])


def _medians(*sessions: onnxruntime.InferenceSession, calls: int = 15) -> list[float]:
    """Median seconds of a call for one hand, for each session. The sessions take turns."""
    patch = {'patches': np.ones((1, 1, PATCH_SIZE, PATCH_SIZE), np.float32)}
    seconds = np.empty((calls, len(sessions)))
    for row in seconds:
        for i, session in enumerate(sessions):
            start = time.perf_counter()
            session.run(None, patch)
            row[i] = time.perf_counter() - start
    return list(np.median(seconds, axis=0))


class OnnxEngine(Engine):
    """Two sessions of ONNX Runtime. The one for a single hand knows all shapes in advance, so no call computes them.

    Args:
        num_threads: maximum number of threads. A single hand gets one thread if more are hardly faster, which is
            measured. The joints are the same.
    """

    name = 'onnxruntime'

    def __init__(self, pipeline: Pipeline, num_threads: int) -> None:
        self.outputs, model = pipeline.outputs, export(pipeline)
        self.threads = num_threads
        """Number of threads for one hand."""
        self._one, self._many = open_session(model, num_threads, batch=1), open_session(model, num_threads)
        if num_threads > 1:
            alone = open_session(model, 1, batch=1)
            seconds, seconds_of_several = _medians(alone, self._one)
            if seconds < WORTH_THREADS * seconds_of_several:
                self._one, self.threads = alone, 1

    def _run(self, patches: Array) -> list[Array]:
        if not len(patches):  # for no patches, ONNX Runtime cannot compute all shapes
            return [answer[:0] for answer in self._run(np.ones((1, *patches.shape[1:]), np.float32))]
        session = self._one if len(patches) == 1 else self._many
        return session.run(None, {'patches': np.ascontiguousarray(patches)})
