// Curves on the film: straight segments, and arcs of the conics that spheres are seen as.
// Each is monotone in x and in y, and has its covered side on the left.
#pragma once

#include "geometry.h"

namespace pinhole {

// A sphere's outline: homogeneous film points row[0] + row[1] w.x + row[2] w.y, w on the unit circle.
struct Frame {
  Vec3 row[3];
  Vec3 at(Vec2 w) const { return row[0] + w.x * row[1] + w.y * row[2]; }
};

inline Vec2 film_point(Vec3 h) { return {ratio(h.x, h.z), ratio(h.y, h.z)}; }

// An end of a curve, and what it moves with: a weighted sum of the homogeneous points of its
// generators (an edge's two vertices, a frame's three rows), weights over depth. Through a lens the
// film point moves with `slope` times the ideal one, and with the lens's own numbers.
struct End {
  Vec2 point;    // on the film
  Vec2 ideal;    // before the lens
  double share[3] = {0, 0, 0};
};

struct Curve {
  End tail, head;        // in the curve's direction
  int32_t generator = 0; // edge, or sphere
  int8_t weight = 0;     // layers of cover on the left less those on the right
  bool on_sphere = false;
  bool arc = false;
};

// A curve from its lower to its upper end.
struct Monotone {
  Vec2 low, high;
  double rising = 1;     // 1 where it runs upwards, else -1
  double rightward = 1;  // 1 where the upper end is the right one, else -1
  int jump = 0;          // layers on its right less those on its left, seen going up
  const Frame* frame = nullptr;

  double width() const { return high.x - low.x; }
  double height() const { return high.y - low.y; }
  bool steep() const { return std::abs(height()) > std::abs(width()); }
};

inline Monotone monotone(const Curve& c, const Frame* frame) {
  const Vec2 a = c.tail.point, b = c.head.point;
  const bool up = b.y >= a.y;
  Monotone m;
  m.low = up ? a : b;
  m.high = up ? b : a;
  m.rising = up ? 1 : -1;
  m.rightward = m.high.x >= m.low.x ? 1 : -1;
  m.jump = up ? -c.weight : c.weight;
  m.frame = c.arc ? frame : nullptr;
  return m;
}

// w on the unit circle with level . (1, w) = 0, growing there (`growing` 1) or falling (-1).
inline Vec2 cut_circle(Vec3 level, double growing) {
  double b = -level.x, x = level.y, y = level.z;
  const double length = std::sqrt(x * x + y * y);
  if (length > 0) {
    x /= length, y /= length, b = std::clamp(b / length, -1.0, 1.0);
  } else {
    x = 1, y = 0, b = std::clamp(b, -1.0, 1.0);
  }
  const double root = growing * std::sqrt((1 - b) * (1 + b));
  return {x * b + y * root, y * b - x * root};
}

// The rows' coordinates number `axis` (0: x, 1: y) past a value, times z.
inline Vec3 past(const Frame& f, int axis, double value) {
  const auto row = [&](Vec3 r) { return r[axis] - value * r.z; };
  return {row(f.row[0]), row(f.row[1]), row(f.row[2])};
}

// The w whose film point has this coordinate, where it grows along the arc or falls.
inline Vec2 unit_at(const Frame& f, int axis, double value, double growing) {
  return cut_circle(past(f, axis, value), growing);
}

// The w of a film point that lies on the conic.
inline Vec2 unit_of(const Frame& f, Vec2 p) {
  const Vec3 x = past(f, 0, p.x), y = past(f, 1, p.y);
  const Vec2 c{x[0], y[0]}, a{x[1], y[1]}, b{x[2], y[2]};
  const double det = a.x * b.y - a.y * b.x;
  const Vec2 w{ratio(b.x * c.y - b.y * c.x, det), ratio(a.y * c.x - a.x * c.y, det)};
  const double length = std::sqrt(w.x * w.x + w.y * w.y);
  return {ratio(w.x, length), ratio(w.y, length)};
}

// Gauss-Legendre on [-1/2, 1/2], the positive half: 8 nodes are exact to 1e-14 over a quarter turn,
// 4 over a tenth of a radian.
inline constexpr double kNode8[4] = {0.09171732124782489, 0.2627662049581645, 0.39833323870681336, 0.4801449282487681};
inline constexpr double kWeight8[4] = {0.18134189168918083, 0.15685332293894344, 0.11119051722668721, 0.05061426814518853};
inline constexpr double kNode4[2] = {0.16999052179242813, 0.4305681557970263};
inline constexpr double kWeight4[2] = {0.3260725774312732, 0.17392742256872679};
constexpr double kShortTurn = 0.1;

// Calls visit(w, film point, its derivative by the angle, depth, weight) along the arc, whichever
// way is shorter.
template <class Visit>
void along_arc(const Frame& f, Vec2 w0, Vec2 w1, Visit visit) {
  const double turn = std::atan2(w0.x * w1.y - w0.y * w1.x, w0.x * w1.x + w0.y * w1.y);
  const double half_cos = std::cos(turn / 2), half_sin = std::sin(turn / 2);
  const Vec2 middle{w0.x * half_cos - w0.y * half_sin, w0.y * half_cos + w0.x * half_sin};
  const bool is_short = std::abs(turn) < kShortTurn;
  const double *node = is_short ? kNode4 : kNode8, *weight = is_short ? kWeight4 : kWeight8;
  for (int k = 0; k < (is_short ? 2 : 4); ++k) {
    const double c = std::cos(turn * node[k]), s = std::sin(turn * node[k]);
    for (const double side : {-s, s}) {
      const Vec2 w{middle.x * c - middle.y * side, middle.y * c + middle.x * side};
      const Vec3 h = f.at(w), change = (-w.y) * f.row[1] + w.x * f.row[2];
      const Vec2 p = film_point(h);
      const Vec2 slope{ratio(change.x - p.x * change.z, h.z), ratio(change.y - p.y * change.z, h.z)};
      visit(w, p, slope, h.z, turn * weight[k]);
    }
  }
}

// The area between an arc's piece and its chord, positive if counter-clockwise.
inline double bulge(const Frame& f, Vec2 start, Vec2 end) {
  double twice = 0;
  along_arc(f, unit_of(f, start), unit_of(f, end), [&](Vec2, Vec2 p, Vec2 slope, double, double q) {
    twice += q * ((p.x - start.x) * slope.y - (p.y - start.y) * slope.x);
  });
  return twice / 2;
}

// The derivative, by the frame's nine numbers, of the area on the left of the arc from w0 to w1.
inline void arc_flux(const Frame& f, Vec2 w0, Vec2 w1, double flux[9]) {
  along_arc(f, w0, w1, [&](Vec2 w, Vec2 p, Vec2 slope, double z, double q) {
    const double nx = slope.y, ny = -slope.x;
    const Vec3 normal = ratio(q, z) * Vec3{nx, ny, -(p.x * nx + p.y * ny)};
    const double basis[3] = {1, w.x, w.y};
    for (int k = 0; k < 9; ++k) flux[k] += basis[k / 3] * normal[k % 3];
  });
}

inline double clamp_between(double x, double a, double b) {
  return std::clamp(x, std::min(a, b), std::max(a, b));
}

// The abscissa at height y, or that of the end which y lies beyond.
inline double x_at(const Monotone& m, double y) {
  if (y <= m.low.y) return m.low.x;
  if (y >= m.high.y) return m.high.x;
  const double x = m.frame ? film_point(m.frame->at(unit_at(*m.frame, 1, y, m.rising))).x
                           : m.low.x + (y - m.low.y) * ratio(m.width(), m.height());
  return clamp_between(x, m.low.x, m.high.x);
}

// The height at abscissa x, within a stretch from (x0, y0) to (x1, y1) of the curve.
inline double y_at(const Monotone& m, double x, double x0, double y0, double x1, double y1) {
  const double y = m.frame ? film_point(m.frame->at(unit_at(*m.frame, 0, x, m.rising * m.rightward))).y
                           : y0 + (x - x0) * ratio(y1 - y0, x1 - x0);
  return std::clamp(y, y0, y1);
}

}  // namespace pinhole
