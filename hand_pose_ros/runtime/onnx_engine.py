"""ONNX Runtime on the CPU: the same graph without Python between its operations, three to five times faster."""

from __future__ import annotations

import inspect
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnxruntime
import torch

from hand_pose_ros.geometry import PATCH_SIZE
from hand_pose_ros.runtime.engine import Array, Engine, Pipeline

OPSET = 17


def export(pipeline: Pipeline) -> bytes:
    """The pipeline as an ONNX model with any number of patches.

    By tracing: the exporter that every supported release of PyTorch has, and that needs no onnxscript.
    """
    example = torch.zeros(2, 1, PATCH_SIZE, PATCH_SIZE)
    batch = {name: {0: 'batch'} for name in ('patches', *pipeline.outputs)}
    # Releases before 2.5 know no other exporter, and not the argument that chooses it.
    choice: dict[str, Any] = {'dynamo': False} if 'dynamo' in inspect.signature(torch.onnx.export).parameters else {}
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter('ignore')
        path = Path(folder) / 'network.onnx'
        torch.onnx.export(pipeline, (example,), str(path), opset_version=OPSET, input_names=['patches'],
                          output_names=list(pipeline.outputs), dynamic_axes=batch, **choice)
        return path.read_bytes()


class OnnxEngine(Engine):
    """A session of ONNX Runtime on `num_threads` threads, of which the caller's is one."""

    name = 'onnxruntime'

    def __init__(self, pipeline: Pipeline, num_threads: int) -> None:
        self.outputs = pipeline.outputs
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = num_threads
        options.inter_op_num_threads = 1
        # Threads that spin between images would take whole cores from the rest of the robot, and wherever cores are
        # shared they slow the network itself down: docs/performance.md.
        options.add_session_config_entry('session.intra_op.allow_spinning', '0')
        # Errors come as exceptions; warnings about the graph are of no use to who runs it.
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(export(pipeline), options, providers=['CPUExecutionProvider'])

    def _run(self, patches: Array) -> list[Array]:
        return self.session.run(None, {'patches': np.ascontiguousarray(patches)})
