"""A differentiable pinhole camera that recovers pose and intrinsics from images."""

from . import formats as formats, io as io, plot as plot, shapes as shapes
from ._camera import Camera as Camera, camera_basis as camera_basis
from ._fit import Fit as Fit, fit_camera as fit_camera
from ._lens import Lens as Lens
from ._metrics import iou as iou, pose_error as pose_error
from ._rays import (
    camera_rays as camera_rays,
    generate_rays as generate_rays,
    project as project,
    Rays as Rays,
)
from ._scene import Mesh as Mesh, Scene as Scene, Spheres as Spheres
from ._silhouette import silhouette as silhouette
from ._trace import Hit as Hit, occluded as occluded, trace as trace
from .io import load_mesh as load_mesh

__version__ = "0.1.0"
