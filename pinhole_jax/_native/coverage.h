// Exact coverage of a film by the curves that bound it.
//
// A curve is cut where it crosses the pixel grid. In each pixel, the pieces add their signed areas
// (Green's theorem) to the layers at its lower left corner, which are counted in integers. Where
// one chain of pieces crosses a pixel that sum is the coverage. Any other pixel is swept: a line
// halts where pieces begin, end or cross, so that the covered part falls into trapezoids; of a
// crowded pixel parts are.
//
// Points on a grid line count for the pixel above it or to its right.
#pragma once

#include "curves.h"

namespace pinhole {

// A part of a curve in one pixel, upwards, in pixel units from the pixel's lower left corner.
struct Piece {
  int32_t curve, column;
  int32_t next;      // in the same row
  int8_t jump;       // layers on its right less those on its left
  int8_t left = 0;   // layers above less those below where it crosses the pixel's left side,
  bool left_at_end;  // and whether it does so at its upper end
  bool bottom;       // crosses the line just above the row's bottom, in this pixel
  bool on_bottom;    // lies on the row's bottom
  bool enters;       // comes from another pixel, in the direction that has cover on the left
  double x0, y0, x1, y1;

  int up() const { return x1 >= x0 ? -jump : jump; }  // layers above less those below
  double left_y() const { return left_at_end ? y1 : y0; }
};

// A stretch of a straight curve, in a pixel, that the background is seen beside. The coverage grows by
// `extent` times the speed across (up, or to the right if the curve is steep) at `moment / extent`.
struct Visible {
  int32_t curve;
  int64_t pixel;
  double extent, moment;
};
// The same of an arc: the derivative of the coverage by its frame.
struct VisibleArc {
  int32_t curve;
  int64_t pixel;
  double flux[9];
};
struct Seen {
  std::vector<Visible> straight;
  std::vector<VisibleArc> arcs;
};

struct Outline {
  std::vector<Curve> curves;
  std::vector<Frame> frames;
  int base = 0;  // layers far to the left of the film
};

// --- pieces ---------------------------------------------------------------------------------------

struct Pieces {
  std::vector<Monotone> curves;
  std::vector<Piece> pieces;
  std::vector<int32_t> row;      // of each piece
  std::vector<int32_t> beside;   // layers that each row gains left of the film
};

class Splitter {
 public:
  Splitter(Pieces& out, int W, int H) : out_(out), W_(W), H_(H) {}

  void split(int32_t number) {
    const Monotone& m = out_.curves[number];
    if (m.jump == 0 || !(m.high.y >= 0 && m.low.y < H_)) return;
    const double first = std::max(std::floor(m.low.y), 0.0);
    const double last = std::min(std::max(std::ceil(m.high.y), first + 1), double(H_));
    double x0 = x_at(m, first), y0 = std::max(m.low.y, 0.0);
    for (double row = first; row < last; ++row) {
      const double x1 = x_at(m, row + 1), y1 = std::min(m.high.y, row + 1);
      split_row(number, m, row, x0, y0, x1, y1);
      x0 = x1, y0 = y1;
    }
  }

 private:
  double column_of(double x) const { return std::floor(std::clamp(x, -1.0, double(W_))); }

  void split_row(int32_t number, const Monotone& m, double row, double x0, double y0, double x1,
                 double y1) {
    if (!std::isfinite(x0) || !std::isfinite(x1)) return;  // numbers too large to be told apart
    const double c0 = column_of(x0), c1 = column_of(x1), step = c1 >= c0 ? 1 : -1;
    const bool passes = m.high.y > row, bottom = passes && y0 <= row && m.high.y > m.low.y;
    if (bottom && c0 < 0) out_.beside[size_t(row)] += m.jump;
    double x_in = x0, y_in = y0;
    for (double c = c0;; c += step) {
      const bool last = c == c1;
      const double x_out = last ? x1 : (step > 0 ? c + 1 : c);
      const double y_out = last ? y1 : y_at(m, x_out, x0, y0, x1, y1);
      if (c >= 0 && c < W_) {
        Piece p;
        p.curve = number, p.column = int32_t(c), p.jump = int8_t(m.jump);
        p.bottom = bottom && c == c0;
        p.on_bottom = !passes;
        const bool crosses = step > 0 ? c != c0 : !last;
        p.left_at_end = step < 0;
        if (crosses && passes) p.left = int8_t(step > 0 ? -m.jump : m.jump);
        const Vec2 start = m.jump <= 0 ? Vec2{x_in, y_in} : Vec2{x_out, y_out};
        const Vec2 own = m.jump <= 0 ? m.low : m.high;
        p.enters = start.x != own.x || start.y != own.y || start.x == c || start.x == c + 1 ||
                   start.y == row || start.y == row + 1;
        p.x0 = x_in - c, p.y0 = y_in - row, p.x1 = x_out - c, p.y1 = y_out - row;
        out_.pieces.push_back(p);
        out_.row.push_back(int32_t(row));
      }
      if (last) break;
      x_in = x_out, y_in = y_out;
    }
  }

  Pieces& out_;
  int W_, H_;
};

// --- one pixel ------------------------------------------------------------------------------------

// The pieces of a pixel, and what a sweep of it needs.
class Pixel {
 public:
  Pixel(const Pieces& all, Seen* seen) : all_(all), seen_(seen) {}

  // The coverage; `corner` layers lie at the lower left corner.
  double coverage(int row, int column, int64_t index, int corner, const int32_t* some, int n) {
    row_ = row, column_ = column, index_ = index, corner_ = corner, some_ = some, n_ = n;
    if (corner - drops() > 0) return 1;
    double mean = corner, layers = 0;
    int entries = 0, ways = 0;
    bool single = true;
    for (int k = 0; k < n; ++k) {
      const Piece& p = piece(k);
      const double dx = p.x1 - p.x0, dy = p.y1 - p.y0;
      if (p.left) mean += p.left * (1 - p.left_y());
      mean += p.jump * dy * (1 - (p.x0 + p.x1) / 2);
      if (const Frame* f = curve(p).frame) {
        mean -= p.jump * bulge(*f, origin() + Vec2{p.x0, p.y0}, origin() + Vec2{p.x1, p.y1});
      }
      layers += std::abs(p.jump);
      single = single && std::abs(p.jump) == 1;
      entries += p.enters;
      const double up = -p.jump * dy, right = -p.jump * dx;
      ways |= (up > kTiny) | (up < -kTiny) << 1 | (right > kTiny) << 2 | (right < -kTiny) << 3;
    }
    if (mean > layers + 0.5) return 1;
    const bool straight = (ways & 3) != 3 || (ways & 12) != 12;
    if (single && entries == 1 && straight && std::abs(mean - 1) > kTie) {
      if (mean > 1) return 1;
      if (seen_) show_all();
      return std::clamp(mean, 0.0, 1.0);
    }
    return by_sweeps();
  }

 private:
  static constexpr double kTiny = 2e-15, kTie = 1e-13;
  static constexpr size_t kFew = 14;
  static constexpr int kDeepest = 24, kBarren = 5;

  struct Step {
    double u;
    int layers;
  };
  struct Met {
    double v;
    int line, jump;
  };
  struct Box {
    double from, to, low, high;
    double width() const { return to - from; }
    double height() const { return high - low; }
    double u() const { return (from + to) / 2; }
    double v() const { return (low + high) / 2; }
    Box half(bool along, bool second) const {
      Box box = *this;
      (along ? second ? box.low : box.high : second ? box.from : box.to) = along ? v() : u();
      return box;
    }
  };
  struct Bar {  // a line, or the part of it in a cell
    double u0, v0, u1, v1, slope;
    int line, jump;          // going up in v
    double at(double u) const { return v0 + (u - u0) * slope; }
    double lower() const { return std::min(v0, v1); }
    double upper() const { return std::max(v0, v1); }
  };
  struct Line : Bar {
    const Piece* piece;
    const Frame* frame;
    double growing;          // of an arc: 1 where u grows along it
    double extent = 0, moment = 0;
  };
  struct Cell {  // a part of the pixel
    Box box;
    int first, drops;         // layers at its lower left corner; those that steps and bars may take
    std::vector<Step> steps;  // of its lower side
    std::vector<Bar> bars;
    void begin(const Box& given, int corner) {
      box = given, first = corner, drops = 0;
      steps.clear(), bars.clear();
    }
    void begin(const Box& given, const Cell& whole) {  // a part of it, as yet without bars
      begin(given, whole.first);
      for (const Step& s : whole.steps) add(s);
    }
    void add(const Step& s) {
      if (s.u <= box.from) first += s.layers;
      else if (s.u < box.to) drops += std::min(s.layers, 0), steps.push_back(s);
    }
    void add(const Bar& bar) {
      if (bar.u0 < bar.u1) drops += std::min(bar.jump, 0), bars.push_back(bar);
    }
  };

  const Piece& piece(int k) const { return all_.pieces[some_[k]]; }
  // The layers that pieces may take from those at the corner, all together.
  int drops() const {
    int sum = 0;
    for (int k = 0; k < n_; ++k) {
      const Piece& p = piece(k);
      const int change = p.left && !p.left_at_end ? -p.jump : p.jump;
      sum += p.on_bottom ? std::abs(p.jump) : std::max(-change, 0);
    }
    return sum;
  }
  const Monotone& curve(const Piece& p) const { return all_.curves[p.curve]; }
  // The pixel's lower left corner.
  Vec2 origin() const { return {double(column_), double(row_)}; }
  // The film's coordinate along the sweep, or across it.
  double film_u(double u) const { return u + origin()[upward_]; }
  double film_v(double v) const { return v + origin()[!upward_]; }

  void show_all() {
    for (int k = 0; k < n_; ++k) {
      const Piece& p = piece(k);
      const Monotone& m = curve(p);
      if (m.frame) {
        const Vec2 low = origin() + Vec2{p.x0, p.y0}, high = origin() + Vec2{p.x1, p.y1};
        see_arc(p, unit_of(*m.frame, low), unit_of(*m.frame, high), m.rising);
      } else {
        const bool steep = m.steep();
        const double extent = steep ? -p.jump * (p.y1 - p.y0) : -p.up() * std::abs(p.x1 - p.x0);
        const double middle = origin()[steep] + (steep ? (p.y0 + p.y1) / 2 : (p.x0 + p.x1) / 2);
        if (extent != 0) seen_->straight.push_back({p.curve, index_, extent, extent * middle});
      }
    }
  }

  double by_sweeps() {
    bool steep = false;
    for (int k = 0; seen_ && k < n_; ++k) steep = steep || needs_upward(piece(k));
    const double area = sweep(false);
    if (steep) sweep(true);
    return std::clamp(area, 0.0, 1.0);
  }
  bool needs_upward(const Piece& p) const {
    return curve(p).frame ? p.y1 - p.y0 > std::abs(p.x1 - p.x0) : curve(p).steep();
  }

  void find_lines() {
    lines_.clear(), steps_.clear();
    has_arcs_ = false;
    for (int k = 0; k < n_; ++k) {
      const Piece& p = piece(k);
      const Monotone& m = curve(p);
      Line l;
      l.line = k, l.piece = &p, l.frame = m.frame;
      has_arcs_ = has_arcs_ || m.frame;
      if (upward_) {
        l.u0 = p.y0, l.v0 = p.x0, l.u1 = p.y1, l.v1 = p.x1, l.jump = p.jump, l.growing = m.rising;
        if (p.left) steps_.push_back({p.left_y(), p.left});
      } else {
        const bool right = p.x1 >= p.x0;
        l.u0 = right ? p.x0 : p.x1, l.v0 = right ? p.y0 : p.y1;
        l.u1 = right ? p.x1 : p.x0, l.v1 = right ? p.y1 : p.y0;
        l.jump = p.up(), l.growing = m.rising * m.rightward;
        if (p.bottom) steps_.push_back({p.x0, p.jump});
        if (p.on_bottom) {  // what lies just above it is counted without it
          steps_.push_back({l.u0, -l.jump});
          steps_.push_back({l.u1, l.jump});
        }
      }
      l.slope = ratio(l.v1 - l.v0, l.u1 - l.u0);
      lines_.push_back(l);
    }
  }

  void add_crossing(const Bar& a, const Bar& b, const Box& box) {
    if (has_arcs_) {
      const Line &one = lines_[a.line], &other = lines_[b.line];
      if (one.frame || other.frame) {
        const double low = std::max({one.u0, other.u0, box.from}), high = std::min({one.u1, other.u1, box.to});
        return add_arc_crossing(one, other, low, high);
      }
    }
    const double low = std::max(a.u0, b.u0), high = std::min(a.u1, b.u1);
    if (!(low < high)) return;
    const double before = a.at(low) - b.at(low), after = a.at(high) - b.at(high);
    if ((before < 0) == (after < 0)) return;
    const double u = low + (high - low) * ratio(before, before - after);
    if (u > low && u < high) halts_.push_back(u);  // (slopes of the smallest numbers are infinite)
  }

  // An arc meets a line where the line cuts its circle, and another arc on a line as well: both
  // cones hold the rays whose products with the two axes are in the cosines' ratio.
  void add_arc_crossing(const Line& a, const Line& b, double low, double high) {
    const Line& arc = a.frame ? a : b;
    const Line& other = a.frame ? b : a;
    const Vec3 met = other.frame ? axis_of(*arc.frame) - axis_of(*other.frame) : through(other);
    const Frame& f = *arc.frame;
    const Vec3 level{dot(met, f.row[0]), dot(met, f.row[1]), dot(met, f.row[2])};
    for (double growing : {1.0, -1.0}) {
      const double u = film_point(f.at(cut_circle(level, growing)))[upward_] - origin()[upward_];
      if (u > low && u < high) halts_.push_back(u);
    }
  }
  // Times a unit ray of the cone: 1.
  static Vec3 axis_of(const Frame& f) {
    const Vec3 n = cross(f.row[1], f.row[2]);
    return ratio(1, dot(n, f.row[0])) * n;
  }
  // The homogeneous line (film coordinates) of a straight piece.
  Vec3 through(const Line& l) const {
    const auto on_film = [&](double u, double v) {
      return upward_ ? Vec3{film_v(v), film_u(u), 1} : Vec3{film_u(u), film_v(v), 1};
    };
    return cross(on_film(l.u0, l.v0), on_film(l.u1, l.v1));
  }

  Vec2 unit_of_line(const Line& l, double u) const { return unit_at(*l.frame, upward_, film_u(u), l.growing); }

  double height_at(const Line& l, double u) const {
    const double v = l.frame ? film_point(l.frame->at(unit_of_line(l, u)))[!upward_] - origin()[!upward_] : l.at(u);
    return clamp_between(v, l.v0, l.v1);
  }

  // Where a line is this high.
  double place_at(const Line& l, double v) const {
    if (!l.frame) return l.u0 + ratio(v - l.v0, l.slope);
    const Monotone& m = curve(*l.piece);
    const Vec2 w = unit_at(*l.frame, !upward_, film_v(v), upward_ ? m.rising * m.rightward : m.rising);
    return film_point(l.frame->at(w))[upward_] - origin()[upward_];
  }

  // The covered area under a line that moves right (or `upward`: then only what is seen counts).
  double sweep(bool upward) {
    upward_ = upward;
    find_lines();
    cells_.resize(kDeepest + 1);
    Cell& whole = cells_[0];
    whole.begin({0, 1, 0, 1}, corner_);
    for (const Step& s : steps_) whole.add(s);
    for (const Line& l : lines_) whole.add(l);
    const double area = within(0, 0);
    if (seen_) collect();
    return area;
  }

  // The covered area of a cell. Of many pieces most are hidden in most places, and the time to sweep
  // a place grows as the square of how many meet there: a crowded cell is halved, twice across, then
  // along, and one that nothing can uncover is passed over. Where halves are about as crowded (a fan)
  // a few times in turn, it is swept as it is.
  double within(int depth, int barren) {
    const Cell& cell = cells_[depth];
    if (cell.first + cell.drops > 0) return cell.box.width() * cell.box.height();
    const size_t count = cell.bars.size();
    if (count <= kFew || depth == kDeepest || barren > kBarren) return swept(cell);
    const bool along = better_along(cell, depth % 3 == 2);
    double area = 0;
    for (const bool second : {false, true}) {
      Cell& half = cells_[depth + 1];
      half.begin(cell.box.half(along, second), cell);
      along ? part_along(cell, second, half) : part_across(cell, second, half);
      area += within(depth + 1, 4 * half.bars.size() > 3 * count ? barren + 1 : 0);
    }
    return area;
  }

  // Whether to halve a cell along, in turn or where that parts bars that most of all run across.
  static bool better_along(const Cell& cell, bool in_turn) {
    const double u = cell.box.u(), v = cell.box.v();
    size_t across = 0, along = 0;  // bars that each way cuts
    for (const Bar& bar : cell.bars) {
      across += bar.u0 < u && u < bar.u1;
      along += bar.lower() < v && v < bar.upper();
    }
    if (8 * std::max(across, along) <= 7 * cell.bars.size()) return in_turn;
    return 4 * along < across || (in_turn && along < 4 * across);
  }

  void part_across(const Cell& cell, bool second, Cell& half) const {
    const double middle = cell.box.u();
    for (Bar bar : cell.bars) {
      if (bar.u0 < middle && middle < bar.u1) {
        (second ? bar.u0 : bar.u1) = middle;
        (second ? bar.v0 : bar.v1) = height_at(lines_[bar.line], middle);
      }
      if (second ? bar.u0 >= middle : bar.u1 <= middle) half.add(bar);
    }
  }

  // What lies below a cell counts as steps of its lower side.
  void part_along(const Cell& cell, bool second, Cell& half) const {
    const double middle = cell.box.v();
    for (const Bar& bar : cell.bars) {
      Bar below = bar, above = bar;
      const bool rises = bar.v0 < middle, falls = bar.v1 < middle;
      if (rises != falls) {
        const double u = std::clamp(place_at(lines_[bar.line], middle), bar.u0, bar.u1);
        (rises ? below.u1 : below.u0) = (rises ? above.u0 : above.u1) = u;
        (rises ? below.v1 : below.v0) = (rises ? above.v0 : above.v1) = middle;
      }
      if (rises || falls) {
        if (second) half.add(Step{below.u0, bar.jump}), half.add(Step{below.u1, -bar.jump});
        else half.add(below);
      }
      if (second && !(rises && falls)) half.add(above);
    }
  }

  double swept(const Cell& cell) {
    const Box& box = cell.box;
    halts_.assign({box.from, box.to});
    const auto halt = [&](double u) { if (u > box.from && u < box.to) halts_.push_back(u); };
    for (const Step& s : cell.steps) halt(s.u);
    for (size_t i = 0; i < cell.bars.size(); ++i) {
      const Bar& a = cell.bars[i];
      halt(a.u0), halt(a.u1);
      for (size_t j = i + 1; j < cell.bars.size(); ++j) {
        const Bar& b = cell.bars[j];
        if (!has_arcs_ && (a.lower() >= b.upper() || b.lower() >= a.upper())) continue;
        add_crossing(a, b, box);
      }
    }
    std::sort(halts_.begin(), halts_.end());
    sorted_.assign(cell.steps.begin(), cell.steps.end());
    std::sort(sorted_.begin(), sorted_.end(), [](const Step& a, const Step& b) { return a.u < b.u; });
    double area = 0;
    int bottom = cell.first;
    size_t passed = 0;
    for (size_t k = 0; k + 1 < halts_.size(); ++k) {
      const double from = halts_[k], to = halts_[k + 1];
      if (!(to > from)) continue;
      for (; passed < sorted_.size() && sorted_[passed].u <= from; ++passed) bottom += sorted_[passed].layers;
      area += strip(cell, bottom, from, to);
    }
    return area;
  }

  double strip(const Cell& cell, int bottom, double from, double to) {
    const double middle = (from + to) / 2, width = to - from;
    if (met_.size() < cell.bars.size()) met_.resize(cell.bars.size());
    Met* const met = met_.data();
    size_t count = 0;
    for (const Bar& bar : cell.bars) {
      if (!(bar.u0 <= middle && middle < bar.u1)) continue;
      const double v = has_arcs_ ? height_at(lines_[bar.line], middle) : bar.at(middle);
      size_t at = count++;
      for (; at > 0 && met[at - 1].v > v; --at) met[at] = met[at - 1];
      met[at] = {v, bar.line, bar.jump};
    }
    int layers = bottom;
    double under = (bottom > 0) * cell.box.low * width;
    for (size_t k = 0; k < count; ++k) {
      const Met& m = met[k];
      const bool below = layers > 0, above = (layers += m.jump) > 0;
      if (below == above) continue;
      Line& l = lines_[m.line];
      const int change = above ? 1 : -1;
      under += change * (l.frame && !upward_ ? area_under(l, from, to) : m.v * width);
      if (!seen_) continue;
      l.extent -= change * width, l.moment -= change * width * film_u(middle);
      if (l.frame && needs_upward(*l.piece) == upward_)
        see_arc(*l.piece, unit_of_line(l, from), unit_of_line(l, to), l.growing);
    }
    return (layers > 0) * cell.box.high * width - under;
  }

  double area_under(const Line& l, double from, double to) const {
    double area = 0;
    along_arc(*l.frame, unit_of_line(l, from), unit_of_line(l, to),
              [&](Vec2, Vec2 p, Vec2 slope, double, double q) { area += q * (p.y - row_) * slope.x; });
    return area;
  }

  // The arc runs from w0 to w1 if `growing` is 1, else back.
  void see_arc(const Piece& p, Vec2 w0, Vec2 w1, double growing) {
    if (growing < 0) std::swap(w0, w1);
    VisibleArc v{p.curve, index_, {}};
    arc_flux(*curve(p).frame, w0, w1, v.flux);
    seen_->arcs.push_back(v);
  }

  void collect() {
    for (const Line& l : lines_)
      if (!l.frame && needs_upward(*l.piece) == upward_ && (l.extent != 0 || l.moment != 0))
        seen_->straight.push_back({l.piece->curve, index_, l.extent, l.moment});
  }

  const Pieces& all_;
  Seen* seen_;
  int row_ = 0, column_ = 0, corner_ = 0, n_ = 0;
  int64_t index_ = 0;
  const int32_t* some_ = nullptr;
  std::vector<Line> lines_;
  std::vector<Step> steps_;
  std::vector<Cell> cells_;  // one of each depth
  std::vector<double> halts_;
  std::vector<Step> sorted_;
  bool has_arcs_ = false, upward_ = false;
  std::vector<Met> met_;
};

// --- the film -------------------------------------------------------------------------------------

// A film drawn from the bottom row up, each row from the left. A sink receives each pixel that a
// curve touches (`at` first asks for its number in `Seen`) and the runs between them.
//
//   void begin(covered);  int64_t at(row, column);
//   void pixel(row, column, coverage);  void run(row, from, to, covered);

// A whole image (H, W), the top row first.
template <class Real>
struct ImageSink {
  Real* image;
  int W, H;
  void begin(bool) {}
  int64_t at(int row, int column) const { return int64_t(H - 1 - row) * W + column; }
  void pixel(int row, int column, double coverage) { image[at(row, column)] = Real(coverage); }
  void run(int row, int from, int to, bool covered) {
    std::fill(image + at(row, from), image + at(row, to), Real(covered));
  }
};

template <class Sink>
void draw(const Outline& outline, int W, int H, Sink& sink, Seen* seen) {
  Pieces all;
  all.beside.assign(H, 0);
  all.curves.reserve(outline.curves.size());
  for (const Curve& c : outline.curves)
    all.curves.push_back(monotone(c, c.arc ? &outline.frames[c.generator] : nullptr));
  Splitter splitter(all, W, H);
  for (size_t k = 0; k < all.curves.size(); ++k) splitter.split(int32_t(k));

  std::vector<int32_t> first_of(H, -1);
  for (size_t k = all.pieces.size(); k-- > 0;) {
    all.pieces[k].next = first_of[all.row[k]];
    first_of[all.row[k]] = int32_t(k);
  }
  sink.begin(outline.base > 0);
  Pixel pixel(all, seen);
  std::vector<uint64_t> in_row;  // column, then the piece's number
  std::vector<int32_t> in_pixel;
  for (int row = 0; row < H; ++row) {
    int corner = outline.base + all.beside[row], from = 0;
    in_row.clear();
    for (int32_t k = first_of[row]; k >= 0; k = all.pieces[k].next)
      in_row.push_back(uint64_t(all.pieces[k].column) << 32 | uint32_t(k));
    std::sort(in_row.begin(), in_row.end());
    for (size_t k = 0; k < in_row.size();) {
      const int column = int(in_row[k] >> 32);
      if (from < column) sink.run(row, from, column, corner > 0);
      int gained = 0;
      in_pixel.clear();
      for (; k < in_row.size() && int(in_row[k] >> 32) == column; ++k) {
        in_pixel.push_back(int32_t(in_row[k]));
        const Piece& p = all.pieces[in_pixel.back()];
        gained += p.bottom ? p.jump : 0;
      }
      const int64_t index = sink.at(row, column);
      sink.pixel(row, column, pixel.coverage(row, column, index, corner, in_pixel.data(), int(in_pixel.size())));
      corner += gained, from = column + 1;
    }
    if (from < W) sink.run(row, from, W, corner > 0);
  }
}

}  // namespace pinhole
