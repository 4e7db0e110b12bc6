"""The pendubot: the acrobot's arm with the first joint driven instead of the second."""

from .arm import TwoLinkArm

Pendubot = TwoLinkArm
drives = (1,)
