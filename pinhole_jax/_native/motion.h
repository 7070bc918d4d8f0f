// How coverage changes as curves move: the visible length of the outline times its speed across.
//
// A straight curve's speed across is linear between its ends; an end moves as the homogeneous
// points do that it is a weighted sum of, and through a lens as the lens's numbers do. `push` takes
// what moves to the image's change, `pull` weights on pixels back to what moves.
#pragma once

#include "contour.h"

namespace pinhole {

struct Scene {
  MeshData mesh;
  SphereData spheres;
};

// All that was worked out of one view.
struct View {
  Film film;
  ContourEdges contour;
  Outline outline;
  Seen seen;
};

template <class Sink>
View look(const Film& film, const Scene& scene, Sink& sink, bool with_seen, const ContourEdges* known = nullptr) {
  View view;
  view.film = film;
  if (scene.mesh.E > 0) {
    view.contour = known ? *known : contour_of(film, scene.mesh);
    add_mesh(film, scene.mesh, view.contour, view.outline);
  }
  if (scene.spheres.S > 0) add_spheres(film, scene.spheres, view.outline);
  draw(view.outline, film.W, film.H, sink, with_seen ? &view.seen : nullptr);
  return view;
}

// What moves: film (18), lens numbers, vertices (V, 3), frames (S, 9). Empty: it stands still.
struct Moves {
  Numbers film, lens, vertices, frames;
};

// The speed at an end across the curve, per px: along y of a flat curve, along x of a steep one.
struct Across {
  bool steep;
  double slope, start, length;  // dy/dx (dx/dy if steep); where the tail is, and how far the head
};
inline Across across(const Curve& c) {
  const Vec2 way = c.head.point - c.tail.point;
  const bool steep = std::abs(way.y) > std::abs(way.x);
  return steep ? Across{true, ratio(way.x, way.y), c.tail.point.y, way.y}
               : Across{false, ratio(way.y, way.x), c.tail.point.x, way.x};
}

// --- forward --------------------------------------------------------------------------------------

class Push {
 public:
  Push(const View& view, const Scene& scene, const Moves& moves)
      : view_(view), scene_(scene), moves_(moves), film_(view.film) {
    if (moves.film.size) change_ = film_of(moves.film);
  }

  template <class Real>
  void add_to(Real* image) const {
    struct Speeds { double tail, head; bool known; };
    std::vector<Speeds> speeds(view_.outline.curves.size(), {0, 0, false});
    for (const Visible& v : view_.seen.straight) {
      const Curve& c = view_.outline.curves[v.curve];
      Speeds& s = speeds[v.curve];
      const Across a = across(c);
      if (!s.known) s = {speed(c, c.tail, a), speed(c, c.head, a), true};
      image[v.pixel] += Real(v.extent * s.tail + ratio(v.moment - v.extent * a.start, a.length) * (s.head - s.tail));
    }
    if (!moves_.frames.size) return;
    for (const VisibleArc& v : view_.seen.arcs) {
      const int64_t sphere = view_.outline.curves[v.curve].generator;
      double sum = 0;
      for (int k = 0; k < 9; ++k) sum += v.flux[k] * moves_.frames[9 * sphere + k];
      image[v.pixel] += Real(sum);
    }
  }

 private:
  Vec3 point_speed(const Curve& c, int k) const {
    if (c.on_sphere) return moves_.frames.size ? moves_.frames.point(3 * int64_t(c.generator) + k) : Vec3{};
    const int32_t v = scene_.mesh.edge_vertices[2 * int64_t(c.generator) + k];
    Vec3 speed;
    Vec3 own = moves_.vertices.size ? moves_.vertices.point(v) : Vec3{};
    if (moves_.film.size) {
      bool there;
      speed = change_.turn(film_.way_to(scene_.mesh.vertices.point(v), there));
      own = own - (there ? change_.view : change_.eye);
      if (there) speed = speed + change_.base;
    }
    return speed + film_.turn(own);
  }

  double speed(const Curve& c, const End& e, const Across& a) const {
    Vec2 at;
    for (int k = 0; k < (c.on_sphere ? 3 : 2); ++k) {
      if (e.share[k] == 0) continue;
      const Vec3 h = point_speed(c, k);
      at = at + e.share[k] * Vec2{h.x - e.ideal.x * h.z, h.y - e.ideal.y * h.z};
    }
    if (film_.lens.model != Model::none) {
      const BentSlopes s = bent_slopes(film_.lens, e.ideal);
      Vec2 bent{s.x[0] * at.x + s.x[1] * at.y, s.y[0] * at.x + s.y[1] * at.y};
      for (int k = 0; k < film_.lens.size() && moves_.lens.size; ++k)
        bent = bent + moves_.lens[k] * Vec2{s.x[2 + k], s.y[2 + k]};
      at = bent;
    }
    return a.steep ? at.x - a.slope * at.y : at.y - a.slope * at.x;
  }

  const View& view_;
  const Scene& scene_;
  const Moves& moves_;
  const Film& film_;
  Film change_;  // the film's numbers' speeds
};

// --- back -----------------------------------------------------------------------------------------

// What `Moves` gain, to be added to.
struct Gains {
  std::vector<double> film, lens, vertices, frames;
  bool wants_vertices = false, wants_frames = false;
};

class Pull {
 public:
  Pull(const View& view, const Scene& scene, Gains& gains)
      : view_(view), scene_(scene), gains_(gains), film_(view.film) {
    gains.film.assign(18, 0), gains.lens.assign(kMostNumbers, 0);
    if (gains.wants_vertices) gains.vertices.assign(3 * scene.mesh.V, 0);
    if (gains.wants_frames) gains.frames.assign(9 * scene.spheres.S, 0);
  }

  void add(const Numbers& weights) {
    struct Loads { double tail, head; };
    std::vector<Loads> loads(view_.outline.curves.size(), {0, 0});
    for (const Visible& v : view_.seen.straight) {
      const double weight = weights[v.pixel];
      if (weight == 0) continue;
      const Across a = across(view_.outline.curves[v.curve]);
      const double far = ratio(v.moment - v.extent * a.start, a.length);
      loads[v.curve].tail += weight * (v.extent - far);
      loads[v.curve].head += weight * far;
    }
    for (size_t k = 0; k < loads.size(); ++k) {
      const Curve& c = view_.outline.curves[k];
      if (loads[k].tail == 0 && loads[k].head == 0) continue;
      const Across a = across(c);
      pull(c, c.tail, a, loads[k].tail);
      pull(c, c.head, a, loads[k].head);
    }
    if (!gains_.wants_frames) return;
    for (const VisibleArc& v : view_.seen.arcs) {
      const int64_t sphere = view_.outline.curves[v.curve].generator;
      for (int k = 0; k < 9; ++k) gains_.frames[9 * sphere + k] += weights[v.pixel] * v.flux[k];
    }
  }

 private:
  static void add_to(std::vector<double>& sums, int64_t row, Vec3 more) {
    for (int k = 0; k < 3; ++k) sums[3 * row + k] += more[k];
  }

  void pull(const Curve& c, const End& e, const Across& a, double load) {
    Vec2 at = a.steep ? Vec2{load, -a.slope * load} : Vec2{-a.slope * load, load};
    if (film_.lens.model != Model::none) {
      const BentSlopes s = bent_slopes(film_.lens, e.ideal);
      for (int k = 0; k < film_.lens.size(); ++k) gains_.lens[k] += at.x * s.x[2 + k] + at.y * s.y[2 + k];
      at = {s.x[0] * at.x + s.y[0] * at.y, s.x[1] * at.x + s.y[1] * at.y};
    }
    const Vec3 homogeneous{at.x, at.y, -(at.x * e.ideal.x + at.y * e.ideal.y)};
    for (int k = 0; k < (c.on_sphere ? 3 : 2); ++k)
      if (e.share[k] != 0) pull_point(c, k, e.share[k] * homogeneous);
  }

  void pull_point(const Curve& c, int k, Vec3 load) {
    if (c.on_sphere) {
      if (gains_.wants_frames) add_to(gains_.frames, 3 * int64_t(c.generator) + k, load);
      return;
    }
    const int32_t v = scene_.mesh.edge_vertices[2 * int64_t(c.generator) + k];
    const Vec3 turned = load.x * film_.row[0] + load.y * film_.row[1] + load.z * film_.row[2];
    if (gains_.wants_vertices) add_to(gains_.vertices, v, turned);
    bool there;
    const Vec3 d = film_.way_to(scene_.mesh.vertices.point(v), there);
    add_to(gains_.film, there ? 1 : 0, -1.0 * turned);
    for (int k = 0; k < 3; ++k) add_to(gains_.film, 2 + k, load[k] * d);
    if (there) add_to(gains_.film, 5, load);
  }

  const View& view_;
  const Scene& scene_;
  Gains& gains_;
  const Film& film_;
};

}  // namespace pinhole
