"""Which face each pixel of a camera's image shows: faces are drawn, and no tree is asked.

The rays of a pinhole leave from one point through the pixels' centres, so a face can be met in the
pixels of the box about its image alone. Boxes are cut into blocks of 4 x 4 px, and some thousand
blocks at a time are tested with long vector operations. Boxes are larger than the images by what
rounding may do, and each ray's test is the tree's, in the frame that the tree takes for this ray:
so the answer is the tree's, but where the last bit decides (two faces of one plane, the eye in a
face) and the compiler rounds the two programs differently, as XLA does from JAX 0.12 on.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._camera.camera import Camera, camera_basis, focal_px, principal_point
from .._numerics.batches import in_turn
from .._numerics.running import running_sum
from .bvh import packed, permuted
from .components import Parts, parts
from .intersect import triangle_depth
from .packets import axes_of, in_packets, out_of_packets

SIDE = 4  # px: of a block
BLOCKS = 4096  # at a time
RULY = 1 / 256  # depth over distance from which on a vertex has a place on the film
SLACK = 64  # roundings that boxes are made larger by
KINDS = 6  # of rays: along x, y, z, each forwards and backwards
BEHIND, UNRULY = 1, 32  # bits of `Outside`; between them one for each side of the film


class View(NamedTuple):
    """Where the film is: axes (rows right, up, forward), focal lengths and principal point, px."""

    axes: Float[Array, "3 3"]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]


class Boxes(NamedTuple):
    """Pixels in which faces may be seen: first and last columns and rows; none if last < first."""

    left: Int[Array, "F"]
    right: Int[Array, "F"]
    top: Int[Array, "F"]
    bottom: Int[Array, "F"]


class Blocks(NamedTuple):
    """Blocks of pixels: each one's upper left pixel, its box's end, and its face and corners."""

    left: Int[Array, "n"]
    top: Int[Array, "n"]
    right: Int[Array, "n"]
    bottom: Int[Array, "n"]
    face: Int[Array, "n"]
    corners: Float[Array, "9 n"]


class Tested(NamedTuple):
    """How deep the rays of each block's pixels meet its face (inf: not), the pixels, the faces."""

    depth: Float[Array, "lanes n"]
    pixel: Int[Array, "lanes n"]
    face: Int[Array, "n"]


class Image(NamedTuple):
    """How deep each pixel's ray meets what it meets first, and which face that is (F: none)."""

    depth: Float[Array, "pixels"]
    face: Int[Array, "pixels"]


def view_of(camera: Camera) -> View:
    """Return where the film of a camera without distortion is."""
    axes = jnp.stack(camera_basis(camera))
    return View(axes, jnp.stack(focal_px(camera)), principal_point(camera))


@jax.custom_batching.custom_vmap
def first_seen(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    view: View,
    origin: Float[Array, "3"],
    direction: Parts,
) -> Int[Array, "H W"]:
    """Return the index of the face that each pixel's ray meets first, -1 for none.

    The same as `first_met` returns for these rays, which have to be the view's, but for what the
    last bit decides (see above). Directions are x, y and z, (H, W) each, of about unit length. Of a
    view without axes (`e = p`, `u` along the view) no pixel meets anything.
    """
    H, W = direction[0].shape
    F = faces.shape[0]
    kind, slopes = _kinds(view, direction)
    offset = vertices - origin[None]
    boxes = _boxes(_places(view, offset, W, H), faces, W, H)

    def draw(state):
        now, image = state
        mine = kind == now
        sign = jnp.where(now % 2 == 1, -1, 1).astype(offset.dtype)
        seen = permuted(parts(offset), now // 2, sign)
        rays = [jnp.where(mine, x, jnp.nan).reshape(-1) for x in slopes]
        image = _drawn(_within(boxes, mine), faces, seen, rays, image, W)
        return jnp.min(jnp.where(kind > now, kind, KINDS)), image

    nothing = Image(jnp.full(H * W, jnp.inf, offset.dtype), jnp.full(H * W, F, jnp.int32))
    start = (jnp.min(kind), nothing)
    met = jax.lax.while_loop(lambda s: s[0] < KINDS, draw, start)[1].face
    return jnp.where(met == F, -1, met).reshape(H, W)


@first_seen.def_vmap
def _batched(size: int, batched: list, *args):
    """One image after another: memory is that of one, and none waits for another."""
    return in_turn(first_seen, batched, args), True


def _kinds(view: View, direction: Parts) -> tuple[Array, tuple[Array, Array]]:
    """Return each ray's kind, twice the axis that it is tested along and one more if it runs
    backwards, and its two slopes there; of rays that can meet nothing `KINDS`."""
    axis = axes_of([in_packets(x) for x in direction])
    axis = out_of_packets(axis, direction[0].shape)
    x, y, z = permuted(direction, axis, 1)
    sign = jnp.where(z < 0, -1, 1).astype(z.dtype)
    kind = 2 * axis + (z < 0).astype(jnp.int32)
    real = jnp.all(jnp.any(view.axes != 0, axis=1)) & (jnp.abs(z) > 0) & jnp.isfinite(x + y + z)
    return jnp.where(real, kind, KINDS), (x / (z * sign), y / (z * sign))


class Places(NamedTuple):
    """Vertices on the film: between which columns (two) and rows (two) each is, in px from the top
    left corner, and as bits what it is outside of: the half space before the eye, the film's sides.
    """

    between: tuple[Float[Array, "V"], ...]
    outside: Int[Array, "V"]


def _places(view: View, offset: Float[Array, "V 3"], W: int, H: int) -> Places:
    """Return where vertices, as seen from the eye, are on the film, give or take rounding."""
    eps = SLACK * jnp.finfo(offset.dtype).eps
    x, y, z = (sum(view.axes[k, i] * offset[:, i] for i in range(3)) for k in range(3))
    far = jnp.max(jnp.abs(offset), axis=1)
    bits = [z < -eps * far]
    ruly, ends = z > RULY * far, []
    for k, (across, size) in enumerate(((x, W), (y, H))):
        focal, centre = view.focal[k], view.centre[k]
        low, high = -centre / focal, (size - centre) / focal
        bits.append(across - low * z < -eps * (1 + jnp.abs(low)) * far)
        bits.append(across - high * z > eps * (1 + jnp.abs(high)) * far)
        ahead = jnp.where(ruly, z, 1)
        middle, spread = centre + focal * (across / ahead), far / ahead
        slack = eps * (focal * spread * (1 + spread) + jnp.abs(centre) + size)
        ends += [middle - slack, middle + slack]
        ruly &= jnp.isfinite(middle) & jnp.isfinite(slack)
    left, right, low, high = ends
    bits.append(~ruly)
    outside = jnp.zeros(far.shape, jnp.int32)
    for k, bit in enumerate(bits):
        outside |= bit.astype(jnp.int32) << k
    return Places((left, right, H - high, H - low), outside)


def _boxes(places: Places, faces: Int[Array, "F 3"], W: int, H: int) -> Boxes:
    """Return the pixels in which each face may be seen.

    None of a face that is behind the eye, or beside one side of the film, as a whole; all of one
    that has a corner without a place.
    """
    a, b, c = (places.outside[faces[:, k]] for k in range(3))
    unseen = a & b & c & (UNRULY - 1) > 0
    anywhere = (a | b | c) & UNRULY > 0
    ends = []
    for k, size in ((0, W), (2, H)):
        low, high = ([places.between[j][faces[:, i]] for i in range(3)] for j in (k, k + 1))
        low = jnp.minimum(jnp.minimum(low[0], low[1]), low[2])
        high = jnp.maximum(jnp.maximum(high[0], high[1]), high[2])
        first = jnp.ceil(jnp.clip(low - 0.5, 0, size)).astype(jnp.int32)
        last = jnp.floor(jnp.clip(high - 0.5, -1, size - 1)).astype(jnp.int32)
        ends += [jnp.where(anywhere, 0, first), jnp.where(anywhere, size - 1, last)]
    left, right, top, bottom = ends
    return Boxes(left, jnp.where(unseen, -1, right), top, bottom)


def _within(boxes: Boxes, mine: Array) -> Boxes:
    """Return what of the boxes is in the box about some of the film's pixels."""
    ends = []
    for axis, size in enumerate(mine.shape[::-1]):
        index, some = jnp.arange(size, dtype=jnp.int32), jnp.any(mine, axis=axis)
        ends += [jnp.min(jnp.where(some, index, size)), jnp.max(jnp.where(some, index, -1))]
    return Boxes(
        jnp.maximum(boxes.left, ends[0]),
        jnp.minimum(boxes.right, ends[1]),
        jnp.maximum(boxes.top, ends[2]),
        jnp.minimum(boxes.bottom, ends[3]),
    )


def _drawn(boxes: Boxes, faces, seen: Parts, rays: Sequence[Array], image: Image, W: int) -> Image:
    """Return the image with the faces drawn into it, the last face first.

    A pipeline of three stages: the blocks that one step lists are tested in the next and drawn in
    the one after that. Each stage reads what the loop carries, else the compiler would merge the
    stages and do the work of one for each element of the next.
    """
    across = jnp.maximum(boxes.right - boxes.left + SIDE, 0) // SIDE
    down = jnp.maximum(boxes.bottom - boxes.top + SIDE, 0) // SIDE
    F, pixels = faces.shape[0], image.depth.shape[0]
    n = min(BLOCKS, 1 << (F * (pixels // SIDE + SIDE)).bit_length())
    # From the last face to the first: of equally deep ones the first is drawn last, and stays.
    backwards = lambda x: jnp.pad(x[::-1], (0, -F % 32))
    ids = backwards(jnp.arange(F, dtype=jnp.int32))
    ids, total = packed(backwards(across * down) > 0, ids)
    ids = jnp.pad(ids, (0, n))
    number = across * down

    def step(state):
        first, done, after, blocks, tested, image = state
        image = _nearest(image, tested)
        tested = _tested(blocks, rays, W)
        after = jnp.where(first < total, 0, after + 1)
        here = jax.lax.dynamic_slice(ids, (first,), (n,))
        some = first + jnp.arange(n, dtype=jnp.int32) < total
        owner, block, faces_done, done = _shared_out(jnp.where(some, number[here], 0), done)
        blocks = _listed(boxes, across, here[owner], block, faces, seen)
        return first + faces_done, done, after, blocks, tested, image

    none = jnp.zeros(n, jnp.int32)
    blocks = Blocks(none, none, none - 1, none, none, jnp.zeros((9, n), image.depth.dtype))
    lanes = jnp.zeros((SIDE * SIDE, n), jnp.int32)
    tested = Tested(jnp.full(lanes.shape, jnp.inf, image.depth.dtype), lanes, none)
    start = (jnp.int32(0), jnp.int32(0), jnp.int32(0), blocks, tested, image)
    return jax.lax.while_loop(lambda s: s[2] < 3, step, start)[-1]


def _shared_out(count: Int[Array, "n"], done: Int[Array, ""]) -> tuple[Array, Array, Array, Array]:
    """Return the next n blocks of faces that have these numbers each, `done` of the first face's
    already.

    As each block's face, a place in the list of counts, and its number among the face's blocks (-1:
    there is none left); how many faces are through with, and how many blocks of the next are done.
    """
    n = count.shape[0]
    slot = jnp.arange(n, dtype=jnp.int32)
    count = jnp.minimum(count.at[0].add(-done), n)  # so that their sum is no large number
    end = running_sum(count)
    owner = running_sum(jnp.zeros(n, jnp.int32).at[end].add(1, mode="drop"))
    live = slot < end[-1]
    owner = jnp.where(live, owner, 0)
    begin = (end - count).at[owner].get(mode="promise_in_bounds")
    block = jnp.where(live, slot - begin + jnp.where(owner == 0, done, 0), -1)
    through = jnp.sum(end <= n, dtype=jnp.int32)
    of_next = n - (end - count)[jnp.minimum(through, n - 1)] + jnp.where(through == 0, done, 0)
    return owner, block, through, jnp.where(through == n, 0, of_next)


def _listed(boxes: Boxes, across, box, block, faces, seen) -> Blocks:
    """Return blocks, given the boxes that they are of and their numbers in these, row by row."""
    at = lambda x: x.at[box].get(mode="promise_in_bounds")
    width = jnp.maximum(at(across), 1)
    left, top = at(boxes.left) + block % width * SIDE, at(boxes.top) + block // width * SIDE
    vertex = [faces.at[box, k].get(mode="promise_in_bounds") for k in range(3)]
    corner = lambda k, i: seen[i].at[vertex[k]].get(mode="promise_in_bounds")
    corners = jnp.stack([corner(k, i) for k in range(3) for i in range(3)])
    right = jnp.where(block < 0, -1, at(boxes.right))
    return Blocks(left, top, right, at(boxes.bottom), box, corners)


def _tested(blocks: Blocks, rays: Sequence[Array], W: int) -> Tested:
    """Return how deep each pixel's ray meets the face of each block."""
    lane = jnp.arange(SIDE * SIDE, dtype=jnp.int32)[:, None]
    column, row = blocks.left[None] + lane % SIDE, blocks.top[None] + lane // SIDE
    inside = (column <= blocks.right[None]) & (row <= blocks.bottom[None])
    pixel = jnp.where(inside, row * W + column, 0)
    x, y = (slope.at[pixel].get(mode="promise_in_bounds") for slope in rays)
    nought = jnp.zeros_like(x)
    depth = triangle_depth(jnp.stack([nought, nought, nought, x, y]), blocks.corners[:, None])
    return Tested(jnp.where(inside, depth, jnp.inf), pixel, blocks.face)


def _nearest(image: Image, tested: Tested) -> Image:
    """Return the image with what is nearer; faces must be no later than those that are drawn."""
    face = jnp.broadcast_to(tested.face[None], tested.depth.shape).reshape(-1)
    here, pixel = tested.depth.reshape(-1), tested.pixel.reshape(-1)
    nowhere = image.depth.shape[0]
    pixel = jnp.where(here < jnp.inf, pixel, nowhere)
    depth = image.depth.at[pixel].min(here, mode="drop")
    nearest = here == depth.at[pixel].get(mode="fill", fill_value=-1)
    drawn = image.face.at[jnp.where(nearest, pixel, nowhere)].min(face, mode="drop")
    return Image(depth, drawn)
