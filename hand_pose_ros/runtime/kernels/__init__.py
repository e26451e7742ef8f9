"""GPU kernels of our own (in Triton). Each does in one kernel what PyTorch does for small layers in three to forty.

For few hands, the number of kernels decides the time, at one to five microseconds each; what they compute hardly
matters. All compute in float32.
"""

import triton

from hand_pose_ros.runtime.kernels import steps
from hand_pose_ros.runtime.kernels.layers import HANDS, convolve, fits, gains, linear
from hand_pose_ros.runtime.kernels.steps import cells, copy, cut, decode, read, seen

__all__ = ['COMPILED', 'HANDS', 'cells', 'convolve', 'copy', 'cut', 'decode', 'fits', 'gains', 'linear', 'read', 'seen']

COMPILED = isinstance(steps._copy, triton.JITFunction)
"""Whether kernels are compiled. With TRITON_INTERPRET=1 they are interpreted on the CPU."""
