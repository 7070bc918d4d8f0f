"""Robots: the scene that a URDF and joint angles make, for `fit_joint` (needs `[robots]`)."""

from .load_urdf import load_urdf as load_urdf
from .robot import Angles as Angles, Robot as Robot
