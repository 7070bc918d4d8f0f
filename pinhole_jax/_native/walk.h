// Which face or sphere each ray meets first, or whether it meets any.
//
// Rays go down a tree of boxes, those that go the same way four together, and what they come to is
// tested in doubles. The answer is that of testing everything: of equally near primitives the first.
#pragma once

#include <cstring>
#include <thread>
#include <type_traits>

#include "tree.h"

namespace pinhole {

constexpr int kAbreast = 4;       // walks at a time: the steps of one wait for its last
constexpr int kBlock = 4096;      // rays that a thread takes at a time
constexpr float kApart = 0.05f;   // how far rays that walk together differ, over their size
constexpr float kShallow = 0x1p-60f;  // depths below count as this: XLA takes the least floats for 0

// A number for each of R rays: of one, or of four beside one another.
template <int R>
struct Lanes;
template <>
struct Lanes<1> {
  typedef double Each;
  typedef bool Mask;
};
template <>
struct Lanes<4> {
  typedef double Each __attribute__((vector_size(32)));
  typedef int64_t Mask __attribute__((vector_size(32)));
};
inline double get(const double& x, int) { return x; }
inline bool get(const bool& x, int) { return x; }
inline double get(const Lanes<4>::Each& x, int r) { return x[r]; }
inline bool get(const Lanes<4>::Mask& x, int r) { return x[r] != 0; }
inline void set(double& x, int, double value) { x = value; }
inline void set(Lanes<4>::Each& x, int r, double value) { x[r] = value; }

template <class Real>
struct Rays {
  const Real* origin;
  int64_t origin_step;  // 0 where all start at one place
  const Real* direction;
  int64_t number;
};

// R rays on their way down the tree.
//
// A ray is turned so that it runs upwards along its longest axis, z, with slopes x and y; depths are
// along that axis. Its boxes' floats begin where it enters the scene.
template <class Real, int R>
class Walk {
 public:
  int64_t first = 0;  // of the rays
  int32_t met[R];

  // Sets out with rays from one on; false if they do not go together, or one is no ray.
  bool start(const Tree& tree, const Rays<Real>& rays, int64_t ray, bool any) {
    first = ray, any_ = any;
    const Real *origin = rays.origin + ray * rays.origin_step, *direction = rays.direction + 3 * ray;
    if (!together(tree, origin, rays.origin_step, direction)) return false;
    double place[R][3], along[R][3];
    scaled_ = single ? 1 : tree.scale, to_boxes_ = single ? tree.scale : 1;
    for (int r = 0; r < R; ++r, origin += rays.origin_step, direction += 3) {
      if (!turn(tree, origin, direction, r, place[r], along[r])) return false;
      met[r] = -1, set(best_, r, INFINITY);
    }
    return bound(tree, place, along);
  }
  bool over() const { return top_ == 0; }

  // Looks at the nearest node that waits: its children wait next, the nearest on top.
  void step(const Tree& tree, const Targets<Real>& targets) {
    const float near = enter_[--top_];
    if (near > depth_) return;
    int32_t bits;
    std::memcpy(&bits, &near, 4);
    const int parent = parent_[top_];
    const int here = parent < 0 ? 0 : tree.nodes[parent].child[bits & 3];
    if (here < 0) return look(tree, ~here, targets);
    const Node& node = tree.nodes[here];
    Four in[3], out[3];
    for (int k = 0; k < 3; ++k) {
      const Four a = node.plane[entry_[k]] - front_[k], b = node.plane[2 * k + 3 - entry_[k]] - back_[k];
      in[k] = R == 1 ? a * slow_[k] : lesser(a * slow_[k], a * fast_[k]);
      out[k] = R == 1 ? b * slow_[k] : larger(b * slow_[k], b * fast_[k]);
    }
    const Four enter = larger(larger(in[0], in[1]), larger(in[2], all(0)));
    const Four leave = lesser(lesser(out[0], out[1]), lesser(out[2], all(depth_)));
    wait(enter, enter <= leave, here);
  }

 private:
  static constexpr bool single = std::is_same<Real, float>::value;  // no product of floats overflows
  typedef typename Lanes<R>::Each Each;
  typedef typename Lanes<R>::Mask Mask;

  static bool together(const Tree& tree, const Real* origin, int64_t step, const Real* direction) {
    Real most = 0;
    for (int k = 0; k < 3; ++k) most = std::max(most, std::abs(direction[k]));
    for (int r = 1; r < R; ++r)
      for (int k = 0; k < 3; ++k) {
        if (!(std::abs(direction[3 * r + k] - direction[k]) <= kApart * most)) return false;
        if (!(std::abs(origin[step * r + k] - origin[k]) * tree.scale <= kApart)) return false;
      }
    return true;
  }

  // Turns a ray, and says where it starts among the boxes and which way it goes there.
  bool turn(const Tree& tree, const Real* origin, const Real* direction, int r, double* place, double* along) {
    const double x = std::abs(double(direction[0])), y = std::abs(double(direction[1])), z = std::abs(double(direction[2]));
    const double most = std::max(x, std::max(y, z));
    if (!(most > 0) || !std::isfinite(x + y + z)) return false;
    const int axis = x == most ? 0 : y == most ? 1 : 2;
    if (r == 0) {
      z_ = axis, x_ = axis == 2 ? 0 : axis + 1, y_ = axis == 0 ? 2 : axis - 1;
      sign_ = direction[axis] < 0 ? -1 : 1;
    }
    if (axis != z_) return false;
    for (int k = 0; k < 3; ++k) {
      along[k] = direction[k] / most;
      place[k] = origin[k] * tree.scale - tree.centre[k];
      if (!(std::abs(place[k]) < 1e30)) return false;  // (where it is says nothing of the scene)
    }
    set(sx_, r, along[x_]), set(sy_, r, along[y_]);
    set(ox_, r, scaled(origin[x_])), set(oy_, r, scaled(origin[y_])), set(oz_, r, scaled(origin[z_]) * sign_);
    return true;
  }

  // Moves the rays to where the first enters the scene, and bounds them there; false if they do not
  // all go forwards, or backwards, along an axis.
  bool bound(const Tree& tree, double (*place)[3], const double (*along)[3]) {
    Four direction[R], per[R];
    for (int r = 0; r < R; ++r) {
      direction[r] = Four{float(along[r][0]), float(along[r][1]), float(along[r][2]), 1};
      const Four32 minus = (Four32)direction[r] & INT32_MIN;
      const Four flat = (Four)(minus | (Four32)all(1e-30f));  // (goes aside by less than any slack)
      per[r] = 1 / (magnitude(direction[r]) < all(1e-30f) ? flat : direction[r]);
    }
    const auto at = [&](int r) { return Four{float(place[r][0]), float(place[r][1]), float(place[r][2]), 0}; };
    float enter = 0, leave = 0;
    start_ = 0;
    for (int turn = 0; turn < 5; ++turn) {  // (from far away the first is not the last)
      enter = INFINITY, leave = -INFINITY;
      for (int r = 0; r < R; ++r) {
        const Four a = (tree.bounds.low - at(r)) * per[r], b = (tree.bounds.high - at(r)) * per[r];
        enter = std::min(enter, greatest(lesser(a, b))), leave = std::max(leave, least(larger(a, b)));
      }
      const double move = std::max(enter, 0.f) * (1 - 32 * kRounding);
      start_ += move;
      for (int r = 0; r < R; ++r)
        for (int k = 0; k < 3; ++k) place[r][k] += move * along[r][k];
      if (enter < 1000) break;
    }
    Four low = at(0), high = low, least_per = per[0], most_per = per[0];
    for (int r = 1; r < R; ++r) {
      for (int k = 0; k < 3; ++k)
        if (std::signbit(per[r][k]) != std::signbit(per[0][k])) return false;
      low = lesser(low, at(r)), high = larger(high, at(r));
      least_per = lesser(least_per, per[r]), most_per = larger(most_per, per[r]);
    }
    low -= 4 * kRounding * magnitude(low) + kTiny, high += 4 * kRounding * magnitude(high) + kTiny;
    for (int k = 0; k < 3; ++k) {
      const bool back = std::signbit(per[0][k]);
      entry_[k] = back ? k + 3 : k;
      front_[k] = all(back ? low[k] : high[k]), back_[k] = all(back ? high[k] : low[k]);
      slow_[k] = all(least_per[k]), fast_[k] = all(most_per[k]);
    }
    depth_ = INFINITY;
    enter_[0] = 0, parent_[0] = -1;
    const bool passes = enter * (1 - 32 * kRounding) <= leave * (1 + 32 * kRounding);
    top_ = passes && leave >= 0 && !tree.nodes.empty();
    return true;
  }

  // Pushes children onto the stack. The last two bits of each entry depth hold the child's number;
  // sorted by depth, children that the ray misses come last and are overwritten.
  void wait(Four enter, Four32 some, int node) {
    const Four32 number = {0, 1, 2, 3};
    Four s = some ? (Four)(((Four32)larger(enter, all(kShallow)) & ~3) | number) : all(-1);
    const Four a = {s[1], s[0], s[3], s[2]}, a1 = larger(s, a), a0 = lesser(s, a);
    s = Four{a1[0], a0[1], a1[2], a0[3]};
    const Four b = {s[2], s[3], s[0], s[1]}, b1 = larger(s, b), b0 = lesser(s, b);
    s = Four{b1[0], b1[1], b0[2], b0[3]};
    const Four c = {s[0], s[2], s[1], s[3]}, c1 = larger(s, c), c0 = lesser(s, c);
    s = Four{s[0], c1[1], c0[2], s[3]};
    const Four32 parents = {node, node, node, node}, pairs = some + Four32{some[2], some[3], some[0], some[1]};
    std::memcpy(enter_ + top_, &s, sizeof s);
    std::memcpy(parent_ + top_, &parents, sizeof parents);
    top_ -= pairs[0] + pairs[1];
  }

  // Tests what is in a leaf.
  void look(const Tree& tree, int leaf, const Targets<Real>& targets) {
    const Primitive* p = &tree.primitives[leaf >> 2];
    for (const Primitive* end = p + (leaf & 3) + 1; p < end; ++p) {
      Each depth;
      if (!(p->corner[0] < 0 ? sphere(targets, p->id, depth) : face(targets.vertices, p->corner, depth))) continue;
      double most = -INFINITY;
      for (int r = 0; r < R; ++r) {
        const double d = get(depth, r), best = get(best_, r);
        if (d > 0 && (d < best || (d == best && p->id < met[r]))) met[r] = p->id, set(best_, r, any_ ? -INFINITY : d);
        most = std::max(most, get(best_, r));
      }
      depth_ = float(most * to_boxes_ - start_) * (1 + 8 * kRounding) + 2 * kShallow;
      if (any_ && most < 0) top_ = 0;
    }
  }

  // How deep rays meet a triangle from either side, edges and vertices included (-1: not); false if
  // none does. After Woop, Benthin and Wald (2013): the signs of three edge functions decide; each
  // compares two products, so that two triangles never disagree about an edge that they share.
  bool face(const Real* vertices, const int32_t* corner, Each& depth) const {
    const Real *a = vertices + corner[0], *b = vertices + corner[1], *c = vertices + corner[2];
    const Each az = scaled(a[z_]) * sign_ - oz_, bz = scaled(b[z_]) * sign_ - oz_, cz = scaled(c[z_]) * sign_ - oz_;
    const Each ax = scaled(a[x_]) - ox_ - sx_ * az, bx = scaled(b[x_]) - ox_ - sx_ * bz, cx = scaled(c[x_]) - ox_ - sx_ * cz;
    const Each ay = scaled(a[y_]) - oy_ - sy_ * az, by = scaled(b[y_]) - oy_ - sy_ * bz, cy = scaled(c[y_]) - oy_ - sy_ * cz;
    const Each u1 = bx * cy, u2 = by * cx, v1 = cx * ay, v2 = cy * ax, w1 = ax * by, w2 = ay * bx;
    const Mask in = ((u1 >= u2) & (v1 >= v2) & (w1 >= w2)) | ((u1 <= u2) & (v1 <= v2) & (w1 <= w2));
    bool some = false;
    for (int r = 0; r < R; ++r) some |= get(in, r);
    if (!some) return false;
    const Each u = u1 - u2, v = v1 - v2, w = w1 - w2, det = u + v + w;
    // (Seen edge-on, all products may be equal, also far beside it.)
    const Mask beside = ((ax > 0) & (bx > 0) & (cx > 0)) | ((ax < 0) & (bx < 0) & (cx < 0)) |
                        ((ay > 0) & (by > 0) & (cy > 0)) | ((ay < 0) & (by < 0) & (cy < 0)) | (det == 0);
    const Each d = (u * az + v * bz + w * cz) / det;
    for (int r = 0; r < R; ++r) set(depth, r, get(in, r) && !get(beside, r) ? get(d, r) : -1);
    return true;
  }

  // The same of a sphere, from within its far wall: by the distance perpendicular to the ray, and
  // the near root from the product of both (Haines et al., Ray Tracing Gems, chapter 7).
  bool sphere(const Targets<Real>& targets, int32_t id, Each& depth) const {
    const Real* center = targets.centers + 3 * (id - targets.F);
    const double radius = scaled(targets.radii[id - targets.F]);
    for (int r = 0; r < R; ++r) {
      const double sx = get(sx_, r), sy = get(sy_, r), size = std::sqrt(1 + sx * sx + sy * sy);
      const Vec3 direction = {sx / size, sy / size, 1 / size};
      const Vec3 c = {scaled(center[x_]) - get(ox_, r), scaled(center[y_]) - get(oy_, r), scaled(center[z_]) * sign_ - get(oz_, r)};
      const double middle = dot(c, direction);
      const Vec3 aside = c - middle * direction;
      const double distance = std::sqrt(dot(aside, aside)), square = (radius - distance) * (radius + distance);
      const double root = std::sqrt(std::max(square, 0.0)), far = middle + (middle < 0 ? -root : root);
      const double length = std::sqrt(dot(c, c)), near = root > 0 ? ratio((length - radius) * (length + radius), far) : far;
      const double t = std::min(near, far) > 0 ? std::min(near, far) : std::max(near, far);
      set(depth, r, square >= 0 ? t / size : -1);
    }
    return true;
  }

  double scaled(Real x) const { return single ? double(x) : x * scaled_; }

  // Of boxes: the planes that are passed first; where from; how deep a unit across each axis takes,
  // at the least and most; what waits, and how deep rays meet what they have met.
  int entry_[3], top_ = 0;
  Four front_[3], back_[3], slow_[3], fast_[3];
  float enter_[kWaiting], depth_ = 0;
  int32_t parent_[kWaiting];
  // Of primitives, in the world's unit (scaled where that may overflow).
  int x_ = 0, y_ = 0, z_ = 0;
  Each sx_, sy_, ox_, oy_, oz_, best_;
  double sign_ = 1, start_ = 0, scaled_ = 1, to_boxes_ = 1;
  bool any_ = false;
};

// Walks with R rays from each of the given on; those that do not go together are left `apart`.
template <class Real, int R>
int64_t walk_each(const Tree& tree, const Targets<Real>& targets, const Rays<Real>& rays, bool any, const int64_t* from, int64_t number, int32_t* met, int64_t* apart) {
  Walk<Real, R> walks[kAbreast];
  int64_t next = 0, alone = 0;
  const auto set_out = [&](Walk<Real, R>& walk) {
    while (next < number) {
      const int64_t ray = from[next++];
      if (walk.start(tree, rays, ray, any)) return true;
      for (int r = 0; r < R; ++r) met[ray + r] = -1, apart[alone++] = ray + r;
    }
    return false;
  };
  int live = 0;
  while (live < kAbreast && set_out(walks[live])) ++live;
  while (live > 0)
    for (int k = 0; k < live; ++k) {
      if (!walks[k].over()) {
        walks[k].step(tree, targets);
        continue;
      }
      std::copy_n(walks[k].met, R, met + walks[k].first);
      if (!set_out(walks[k])) walks[k--] = walks[--live];
    }
  return alone;
}

template <class Real>
void walk_block(const Tree& tree, const Targets<Real>& targets, const Rays<Real>& rays, bool any, int64_t begin, int64_t end, int32_t* met) {
  int64_t from[kBlock], apart[kBlock], packets = 0;
  for (int64_t ray = begin; ray + 4 <= end; ray += 4) from[packets++] = ray;
  int64_t alone = walk_each<Real, 4>(tree, targets, rays, any, from, packets, met, apart);
  for (int64_t ray = begin + 4 * packets; ray < end; ++ray) apart[alone++] = ray;
  walk_each<Real, 1>(tree, targets, rays, any, apart, alone, met, from);
}

// Says for each ray which primitive it meets first, or of `any` one that it meets; -1 for none.
template <class Real>
void walk(const Tree& tree, const Targets<Real>& targets, const Rays<Real>& rays, bool any, int32_t* met) {
  const int64_t blocks = (rays.number + kBlock - 1) / kBlock;
  const int64_t cores = std::max<int64_t>(std::thread::hardware_concurrency(), 1);
  const int64_t threads = std::min(cores, blocks / 8 + 1);
  const auto share = [&](int64_t thread) {
    for (int64_t b = thread; b < blocks; b += threads)
      walk_block(tree, targets, rays, any, b * kBlock, std::min(rays.number, (b + 1) * kBlock), met);
  };
  std::vector<std::thread> others;
  int64_t started = 1;
  try {
    for (; started < threads; ++started) others.emplace_back(share, started);
  } catch (const std::exception&) {  // (no more threads are to be had)
  }
  share(0);
  for (std::thread& t : others) t.join();
  for (; started < threads; ++started) share(started);
}

}  // namespace pinhole
