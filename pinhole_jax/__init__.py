"""A differentiable pinhole camera that recovers pose and intrinsics from images."""

from . import formats as formats
from . import io as io
from . import plot as plot
from . import report as report
from . import shapes as shapes
from ._camera import Camera as Camera
from ._camera import camera_basis as camera_basis
from ._certificate import Certificate as Certificate
from ._certificate import check_gradients as check_gradients
from ._fit import Fit as Fit
from ._fit import Progress as Progress
from ._fit import fit_camera as fit_camera
from ._fit_cameras import fit_cameras as fit_cameras
from ._images import depth as depth
from ._images import normals as normals
from ._lens import Lens as Lens
from ._metrics import iou as iou
from ._metrics import pose_error as pose_error
from ._observability import Observability as Observability
from ._observability import observability as observability
from ._rays import (
    Rays as Rays,
)
from ._rays import (
    camera_rays as camera_rays,
)
from ._rays import (
    generate_rays as generate_rays,
)
from ._rays import (
    project as project,
)
from ._scene import Mesh as Mesh
from ._scene import Scene as Scene
from ._scene import Spheres as Spheres
from ._silhouette import silhouette as silhouette
from ._trace import Hit as Hit
from ._trace import occluded as occluded
from ._trace import trace as trace
from .io import load_mesh as load_mesh

__version__ = "0.1.0"
