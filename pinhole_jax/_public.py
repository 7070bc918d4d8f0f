"""All that users may name, as `pinhole_jax.NAME`: `__init__` loads it when one is asked for."""

from . import names as names
from ._camera.camera import Camera as Camera, camera_basis as camera_basis
from ._camera.distortion import (
    BrownConrady as BrownConrady,
    Fisheye as Fisheye,
    Rational as Rational,
)
from ._camera.lens import Lens as Lens
from ._camera.rays import (
    Rays as Rays,
    camera_rays as camera_rays,
    generate_rays as generate_rays,
    project as project,
    rays_through as rays_through,
)
from ._files.cache import cache as cache
from ._files.process import set_up as set_up
from ._fit.drift import Drift as Drift, drift as drift
from ._fit.fit_camera import fit_camera as fit_camera
from ._fit.full_image import residuals as residuals
from ._fit.metrics import iou as iou, pose_error as pose_error
from ._fit.observability import Observability as Observability, observability as observability
from ._fit.result import Fit as Fit, Progress as Progress
from ._halves import (
    SplitCheck as SplitCheck,
    SplitPart as SplitPart,
    outline_halves as outline_halves,
    split_check as split_check,
)
from ._joint.fit_joint import fit_cameras as fit_cameras, fit_joint as fit_joint
from ._joint.joint_fit import JointFit as JointFit
from ._joint.joint_observability import joint_observability as joint_observability
from ._joint.views import JointView as JointView
from ._points.fit_points import PointFit as PointFit, fit_points as fit_points
from ._scene.assembly import Assembly as Assembly, Posture as Posture
from ._scene.scene import Mesh as Mesh, Scene as Scene, Spheres as Spheres
from ._silhouette.silhouette import silhouette as silhouette
from ._silhouette.visible import contour_points as contour_points, outline as outline
from ._trace.images import depth as depth, normals as normals
from ._trace.trace import Hit as Hit, occluded as occluded, trace as trace
from .io import load_mesh as load_mesh
from .testing import Certificate as Certificate, check_gradients as check_gradients

# isort: split
# Guests, which import the names above from the package.
from . import (
    batch as batch,
    formats as formats,
    io as io,
    plot as plot,
    report as report,
    robots as robots,
    shapes as shapes,
    testing as testing,
)
from .batch import fit_many as fit_many, fit_one as fit_one
