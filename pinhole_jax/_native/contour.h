// What a film sees of a scene: the edges between front and back faces, and spheres as conics.
#pragma once

#include "coverage.h"
#include "lens.h"

namespace pinhole {

struct Film {
  Vec3 eye, view, base, row[3];
  int W = 0, H = 0;
  double left, right, low, high;  // where contours are cut off, well outside the (ideal) film
  Lens lens;

  // How a point is reached from the eye; from the view point (`there`) if that is nearer: an object
  // that is looked at from afar keeps its digits.
  Vec3 way_to(Vec3 p, bool& there) const {
    const Vec3 from_eye = p - eye, from_view = p - view;
    there = largest(from_view) < largest(from_eye);
    return there ? from_view : from_eye;
  }
  // Homogeneous film point (x z, y z, z).
  Vec3 at(Vec3 p) const {
    bool there;
    const Vec3 h = turn(way_to(p, there));
    return there ? h + base : h;
  }
  Vec3 turn(Vec3 d) const { return {dot(row[0], d), dot(row[1], d), dot(row[2], d)}; }
};

// The film of numbers (eye, view, three rows, base), or their changes, as yet without size and lens.
inline Film film_of(const Numbers& n) {
  return {n.point(0), n.point(1), n.point(5), {n.point(2), n.point(3), n.point(4)}};
}
// `lens`: what the lens's model needs, then its trusted radius.
inline Film film_of(const Numbers& n, const Numbers& lens, Model model, int W, int H) {
  Film f = film_of(n);
  f.W = W, f.H = H;
  f.left = -W, f.right = 2.0 * W, f.low = -H, f.high = 2.0 * H;
  f.lens.model = model;
  if (model != Model::none) {
    for (int k = 0; k < f.lens.size(); ++k) f.lens.numbers[k] = lens[k];
    f.lens.trusted = lens[f.lens.size()];
    double bounds[4];
    ideal_bounds(f.lens, W, H, bounds);
    f.left = bounds[0], f.right = bounds[1], f.low = bounds[2], f.high = bounds[3];
  }
  return f;
}

struct MeshData {
  Numbers vertices;
  const int32_t *faces, *edge_vertices, *edge_faces;
  int64_t V, F, E;

  // Without what arrays are filled up with: faces whose vertices are -1, edges with such a face.
  MeshData without_padding() const {
    const auto first = [](int64_t size, auto is_added) {
      int64_t low = 0;
      while (low < size) {
        const int64_t middle = low + (size - low) / 2;
        if (is_added(middle)) size = middle;
        else low = middle + 1;
      }
      return low;
    };
    MeshData own = *this;
    own.F = first(F, [&](int64_t f) { return faces[3 * f] < 0; });
    own.E = first(E, [&](int64_t e) { return edge_faces[2 * e] >= own.F; });
    if (V <= own.F) return own;  // (Which of few vertices are added is not worth a look at all faces.)
    int32_t last = -1;
    for (int64_t k = 0; k < 3 * own.F; ++k) last = std::max(last, faces[k]);
    own.V = std::min(V, int64_t(last) + 1), own.vertices.size = 3 * own.V;
    return own;
  }
};

// --- which way faces look -------------------------------------------------------------------------

inline bool within(int32_t index, int64_t size) { return uint32_t(index) < uint64_t(size); }

inline std::vector<uint8_t> front_facing(const MeshData& m, Vec3 eye) {
  std::vector<uint8_t> front(m.F);
  for (int64_t f = 0; f < m.F; ++f) {
    const int32_t* v = m.faces + 3 * f;
    if (!(within(v[0], m.V) && within(v[1], m.V) && within(v[2], m.V))) continue;
    const Vec3 a = m.vertices.point(v[0]);
    const Vec3 normal = cross(m.vertices.point(v[1]) - a, m.vertices.point(v[2]) - a);
    front[f] = dot(normal, eye - a) > 0;
  }
  return front;
}

// --- edges cut off --------------------------------------------------------------------------------

struct Spot {
  Vec3 at;
  double height, t;
};

// Where an edge ends between two heights; false if none of it is there.
inline bool between_rows(const Vec3 ends[2], double low, double high, Spot spots[2]) {
  double below[2], above[2];
  for (int k = 0; k < 2; ++k) {
    below[k] = low * ends[k].z - ends[k].y;
    above[k] = ends[k].y - high * ends[k].z;
  }
  const double t_low = ratio(below[0], below[0] - below[1]);
  const double t_high = ratio(above[0], above[0] - above[1]);
  for (int k = 0; k < 2; ++k) {
    const bool is_low = below[k] > 0, is_high = above[k] > 0;
    double t = k;
    if (is_low && is_high) t = k == 0 ? std::max(t_low, t_high) : std::min(t_low, t_high);
    else if (is_low) t = t_low;
    else if (is_high) t = t_high;
    const bool at_top = is_high && (!is_low || t == t_high);
    const bool out = is_low || is_high;
    spots[k].at = out ? ends[0] + t * (ends[1] - ends[0]) : ends[k];
    spots[k].height = at_top ? high : is_low ? low : ratio(spots[k].at.y, spots[k].at.z);
    spots[k].t = t;
  }
  return !((below[0] > 0 && below[1] > 0) || (above[0] > 0 && above[1] > 0) || spots[0].t > spots[1].t);
}

inline double height_of_crossing(double past0, double past1, const Spot spots[2]) {
  const double t = std::clamp(ratio(past0, past0 - past1), 0.0, 1.0);
  const Vec3 p = spots[0].at + t * (spots[1].at - spots[0].at);
  return clamp_between(ratio(p.y, p.z), spots[0].height, spots[1].height);
}

// How much a point of an edge moves with each end, over depth.
inline void set_shares(End& end, const Vec3 ends[2], const double scale[2]) {
  const Vec3 a = ends[0], b = ends[1];
  const bool steep = std::abs(a.y * b.z - a.z * b.y) > std::abs(a.z * b.x - a.x * b.z);
  const auto past = [&](Vec3 h) { return h[steep] - end.ideal[steep] * h.z; };
  const double t = std::clamp(ratio(past(a), past(a) - past(b)), 0.0, 1.0);
  const double z = a.z + t * (b.z - a.z);
  end.share[0] = ratio(1 - t, z) * scale[0];
  end.share[1] = ratio(t, z) * scale[1];
}

// A factor that brings a homogeneous point to an ordinary size: products neither overflow nor vanish.
inline double scale_of(Vec3 h) {
  const double size = largest(h);
  if (!(size > 0) || !std::isfinite(size) || (size > 1e-60 && size < 1e60)) return 1;
  return std::ldexp(1.0, -std::ilogb(size));
}

// --- parts under a lens ---------------------------------------------------------------------------

constexpr double kStrayPx = 2e-4, kMargin = 1.3;  // how far straight parts may lie from a bent curve
constexpr int kMostParts = 1 << 14;

// Adds a curve whose end at a share (0 to 1) of it is `end_at(share)`; through a lens, cut into parts
// so short that straight ones follow the image. Its bending is looked at in `samples` stretches.
template <class EndAt>
void add_parts(const Film& film, Curve c, EndAt end_at, int samples, std::vector<Curve>& out) {
  c.tail = end_at(0.0), c.head = end_at(1.0);
  if (film.lens.model == Model::none) {
    c.tail.point = c.tail.ideal, c.head.point = c.head.ideal;
    out.push_back(c);
    return;
  }
  double second = 0;
  Vec2 before, last = bent(film.lens, c.tail.ideal);
  for (int k = 1; k <= samples; ++k) {
    const Vec2 here = bent(film.lens, end_at(double(k) / samples).ideal);
    if (k > 1) second = std::max(second, norm(before - 2.0 * last + here));
    before = last, last = here;
  }
  const double needed = std::sqrt(kMargin * second * samples * samples / (8 * kStrayPx));
  const int parts = int(std::clamp(std::ceil(needed), 1.0, double(kMostParts)));
  c.tail.point = bent(film.lens, c.tail.ideal);
  for (int k = 1; k <= parts; ++k) {
    c.head = end_at(double(k) / parts);
    c.head.point = bent(film.lens, c.head.ideal);
    out.push_back(c);
    c.tail = c.head;
  }
}

// Adds what lies left of the film, as an upright there. It shows nowhere and moves nothing.
inline void add_beside(const Film& film, Curve c, const double y[2], std::vector<Curve>& out) {
  c.tail = {bent(film.lens, {film.left, y[0]})}, c.head = {bent(film.lens, {film.left, y[1]})};
  out.push_back(c);
}

// Adds what the film may show of an edge, and what of it lies left of the film.
inline void add_edge(const Film& film, Vec3 a, Vec3 b, int32_t edge, int weight, std::vector<Curve>& out) {
  const double scale[2] = {scale_of(a), scale_of(b)};
  const Vec3 ends[2] = {scale[0] * a, scale[1] * b};
  if (ends[0].z <= 0 && ends[1].z <= 0) return;
  Spot spots[2];
  if (!between_rows(ends, film.low, film.high, spots)) return;
  double past_left[2], past_right[2];
  for (int k = 0; k < 2; ++k) {
    past_left[k] = film.left * spots[k].at.z - spots[k].at.x;
    past_right[k] = spots[k].at.x - film.right * spots[k].at.z;
  }
  const bool beside = past_left[0] > 0 || past_left[1] > 0;
  const bool beyond = (past_left[0] > 0 && past_left[1] > 0) || (past_right[0] > 0 && past_right[1] > 0);
  const double y_left = height_of_crossing(past_left[0], past_left[1], spots);
  const double y_right = height_of_crossing(past_right[0], past_right[1], spots);
  Curve c;
  c.generator = edge, c.weight = int8_t(weight);
  if (!beyond) {
    Vec2 spot[2];
    for (int k = 0; k < 2; ++k) {
      const bool l = past_left[k] > 0, r = past_right[k] > 0;
      spot[k].x = l ? film.left : r ? film.right : ratio(spots[k].at.x, spots[k].at.z);
      spot[k].y = l ? y_left : r ? y_right : spots[k].height;
    }
    const auto end_at = [&](double t) {
      End e;
      e.ideal = t >= 1 ? spot[1] : spot[0] + t * (spot[1] - spot[0]);
      set_shares(e, ends, scale);
      return e;
    };
    add_parts(film, c, end_at, norm(spot[1] - spot[0]) < std::min(film.W, film.H) / 16.0 ? 2 : 16, out);
  }
  if (beside) {
    const double y[2] = {past_left[0] > 0 ? spots[0].height : y_left, past_left[1] > 0 ? spots[1].height : y_left};
    add_beside(film, c, y, out);
  }
}

// --- layers around the eye ------------------------------------------------------------------------

constexpr int kEverywhere = 1 << 20;

// On which side of the edge between two vertices, seen along x, the ray passes: the same for both
// faces that share the edge, but for the sign.
struct Side {
  double value;
  int sign;
};
inline Side side_of(const std::vector<Vec3>& points, int32_t first, int32_t second) {
  const Vec3 a = points[std::min(first, second)], b = points[std::max(first, second)];
  const double left = a.y * b.z, right = b.y * a.z;
  const double tie = a.z != b.z ? b.z - a.z : b.y - a.y;
  const int sign = left != right ? (left > right ? 1 : -1) : (tie > 0) - (tie < 0);
  return first > second ? Side{right - left, -sign} : Side{left - right, sign};
}

// Layers that the ray along -x from the eye meets. The ray is thought to lie a little below y = 0,
// and much less in front of z = 0, so that it never meets an edge.
inline int layers_on_the_left(const MeshData& m, const Film& film, const std::vector<uint8_t>& front, bool closed) {
  std::vector<Vec3> points(m.V);
  for (int64_t v = 0; v < m.V; ++v) {
    const Vec3 h = film.at(m.vertices.point(v));
    points[v] = scale_of(h) * h;
  }
  int crossings = 0, fronts = 0;
  for (int64_t f = 0; f < m.F; ++f) {
    const int32_t* corners = m.faces + 3 * f;
    if (!(within(corners[0], m.V) && within(corners[1], m.V) && within(corners[2], m.V))) continue;
    double toward = 0;
    int signs = 0;
    for (int k = 0; k < 3; ++k) {
      const Side side = side_of(points, corners[k], corners[(k + 1) % 3]);
      toward += points[corners[(k + 2) % 3]].x * side.value;
      signs += side.sign;
    }
    const bool met = (signs == 3 && toward < 0) || (signs == -3 && toward > 0);
    const int orientation = met ? (signs > 0 ? -1 : 1) : 0;
    crossings += orientation;
    fronts += front[f] ? orientation : 0;
  }
  return closed ? fronts + (crossings != 0 ? kEverywhere : 0) : 2 * fronts - crossings;
}

// --- a mesh ---------------------------------------------------------------------------------------

inline bool reaches_behind(const MeshData& m, const Film& film) {
  Vec3 lo{INFINITY, INFINITY, INFINITY}, hi{-INFINITY, -INFINITY, -INFINITY};
  for (int64_t v = 0; v < m.V; ++v) {
    const Vec3 p = m.vertices.point(v);
    lo = {std::min(lo.x, p.x), std::min(lo.y, p.y), std::min(lo.z, p.z)};
    hi = {std::max(hi.x, p.x), std::max(hi.y, p.y), std::max(hi.z, p.z)};
  }
  for (int k = 0; k < 8; ++k) {
    const Vec3 corner{k & 1 ? hi.x : lo.x, k & 2 ? hi.y : lo.y, k & 4 ? hi.z : lo.z};
    if (!(film.at(corner).z > 0)) return true;
  }
  return false;
}

// The edges between front and back faces, and borders: twice an edge, and 1 where its first face is
// a front; the layers far to the left of the film.
struct ContourEdges {
  std::vector<int32_t> edges;
  bool closed = true;
  int base = 0;
};

inline ContourEdges contour_of(const Film& film, const MeshData& m) {
  ContourEdges found;
  const std::vector<uint8_t> front = front_facing(m, film.eye);
  int32_t least = 0;
  for (int64_t e = 0; e < m.E; ++e) {
    const int32_t first = m.edge_faces[2 * e], second = m.edge_faces[2 * e + 1];
    least = std::min(least, second);
    if (!within(first, m.F) || second >= m.F) continue;
    if (second < 0 || front[second] != front[first]) found.edges.push_back(int32_t(2 * e + front[first]));
  }
  found.closed = least == 0;
  if (m.F > 0 && reaches_behind(m, film)) found.base = layers_on_the_left(m, film, front, found.closed);
  return found;
}

inline void add_mesh(const Film& film, const MeshData& m, const ContourEdges& contour, Outline& out) {
  out.base += contour.base;
  for (const int32_t edge : contour.edges) {
    const int32_t e = edge >> 1;
    if (!within(e, m.E)) continue;
    const bool border = m.edge_faces[2 * int64_t(e) + 1] < 0;
    const int weight = (edge & 1 ? 1 : -1) * (contour.closed || border ? 1 : 2);
    const int32_t* v = m.edge_vertices + 2 * int64_t(e);
    if (!within(v[0], m.V) || !within(v[1], m.V)) continue;
    add_edge(film, film.at(m.vertices.point(v[0])), film.at(m.vertices.point(v[1])), e, weight, out.curves);
  }
}

// --- spheres --------------------------------------------------------------------------------------

constexpr double kFar = 1e15;

inline Vec2 arc_end(const Frame& f, Vec2 w, int inward) {
  const Vec3 p = f.at(w);
  const double tiny = 64 * std::numeric_limits<double>::epsilon();
  if (p.z > tiny) return {p.x / p.z, p.y / p.z};
  const Vec3 change = double(inward) * (w.x * f.row[2] - w.y * f.row[1]);
  const auto far = [&](int axis) {
    double most = 0;
    for (const Vec3& row : f.row) most = std::max(most, std::abs(row[axis]));
    return std::copysign(kFar, std::abs(p[axis]) <= tiny * most ? change[axis] : p[axis]);
  };
  return {far(0), far(1)};
}

// Where a conic is level or upright, and where it meets the plane through the eye, by angle.
inline int turning_points(const Frame& f, Vec2 points[6]) {
  const Vec3 *r = f.row;
  const auto column = [&](int axis) { return Vec3{r[0][axis], r[1][axis], r[2][axis]}; };
  const auto turns = [&](int axis) {
    const Vec3 minors = cross(column(axis), column(2));
    return Vec3{-minors.x, minors.y, minors.z};
  };
  int n = 0;
  for (const Vec3 l : {column(2), turns(0), turns(1)}) {
    const bool exists = std::abs(l.x) < std::sqrt(l.y * l.y + l.z * l.z);
    if (exists || n == 0) points[n++] = cut_circle(l, 1);
    if (exists) points[n++] = cut_circle(l, -1);
  }
  std::sort(points, points + n, [](Vec2 a, Vec2 b) { return std::atan2(a.y, a.x) < std::atan2(b.y, b.x); });
  return n;
}

// The angle from a to b, counter-clockwise; as 0 if b is a little before a.
inline double turn_between(Vec2 a, Vec2 b) {
  const double pi = std::acos(-1.0);  // (M_PI is no standard name: Windows has none)
  const double angle = std::atan2(a.x * b.y - a.y * b.x, a.x * b.x + a.y * b.y);
  return angle < -pi / 2 ? angle + 2 * pi : angle;
}

// Adds what of an arc the film may show through a lens, as straight parts, and what lies left of it.
inline void add_bent_arc(const Film& film, const Frame& frame, Curve c, Vec2 start, Vec2 end, std::vector<Curve>& out) {
  const Vec2 ends[2] = {arc_end(frame, start, 1), arc_end(frame, end, -1)};
  const double whole = turn_between(start, end);
  double begin = 0, finish = whole, heights[2] = {ends[0].y, ends[1].y};
  Vec2 last = end;
  bool beside = false;
  for (int axis = 0; axis < 2; ++axis) {
    const double grows = ends[1][axis] >= ends[0][axis] ? 1 : -1;
    for (int side : {-1, 1}) {
      const double value = axis ? (side < 0 ? film.low : film.high) : (side < 0 ? film.left : film.right);
      const Vec2 w = unit_at(frame, axis, value, grows);
      const bool out_first = side * (ends[0][axis] - value) > 0, out_last = side * (ends[1][axis] - value) > 0;
      const double cut = std::clamp(turn_between(start, w), 0.0, whole);
      if (axis == 0 && side < 0) {
        const double y = film_point(frame.at(w)).y;
        if (!out_first) heights[0] = y;
        if (!out_last) heights[1] = y;
        beside = out_first || out_last;
      }
      if (out_first) begin = std::max(begin, out_last ? INFINITY : cut);
      if (out_last && cut < finish) finish = cut, last = w;
    }
  }
  if (begin < finish) {
    c.arc = false;
    const auto end_at = [&](double t) {
      const double angle = begin + t * (finish - begin), cosine = std::cos(angle), sine = std::sin(angle);
      const Vec2 w = t >= 1 ? last : Vec2{start.x * cosine - start.y * sine, start.y * cosine + start.x * sine};
      const Vec3 h = frame.at(w);
      End e;
      e.ideal = film_point(h);
      e.share[0] = ratio(1, h.z), e.share[1] = ratio(w.x, h.z), e.share[2] = ratio(w.y, h.z);
      return e;
    };
    add_parts(film, c, end_at, 16, out);
  }
  for (double& y : heights) y = std::clamp(y, film.low, film.high);
  c.arc = false;
  if (beside) add_beside(film, c, heights, out);
}

inline void add_sphere(const Film& film, const Frame& frame, int32_t number, std::vector<Curve>& out) {
  Vec2 points[6];
  const int n = turning_points(frame, points);
  for (int k = 0; k < n; ++k) {
    const Vec2 a = points[k], b = points[(k + 1) % n];
    Vec2 middle{b.y - a.y, a.x - b.x};
    const double size = norm(middle);
    if (n > 1 && !(size > 0)) continue;
    middle = n > 1 ? (1 / size) * middle : Vec2{-a.x, -a.y};
    if (!(frame.at(middle).z > 0)) continue;
    Curve c;
    c.generator = number, c.on_sphere = c.arc = true, c.weight = 1;
    if (film.lens.model != Model::none) {
      add_bent_arc(film, frame, c, a, b, out);
      continue;
    }
    c.tail.point = arc_end(frame, a, 1), c.head.point = arc_end(frame, b, -1);
    out.push_back(c);
  }
}

struct SphereData {
  Numbers centers, radii, frames;
  int64_t S = 0;
};

inline void add_spheres(const Film& film, const SphereData& s, Outline& out) {
  const Vec3 across = cross(film.row[1], film.row[2]);
  const Vec3 left = ratio(1, std::sqrt(dot(across, across))) * across;
  for (int64_t k = 0; k < s.S; ++k) {
    Frame f;
    for (int r = 0; r < 3; ++r) f.row[r] = s.frames.point(3 * k + r);
    out.frames.push_back(f);
    const Vec3 centre = s.centers.point(k) - film.eye;
    const double distance = std::sqrt(dot(centre, centre)), radius = s.radii[k];
    if (distance <= radius) {
      out.base += kEverywhere;
      continue;
    }
    const double tangent = std::sqrt(distance - radius) * std::sqrt(distance + radius);
    out.base += dot(centre, left) >= tangent;
    add_sphere(film, f, int32_t(k), out.curves);
  }
}

}  // namespace pinhole
