// A fit's look at a mask: the residuals of the pixels that an outline touches, their derivatives by
// the fit's moves, and sums over all pixels. The untouched ones between them are differences of the
// mask's running sums, so a look costs what the outline does.
#pragma once

#include <cstdlib>
#include <memory>
#include <new>

#include "motion.h"

namespace pinhole {

// A level of a mask, as `_mask/pyramid.py` keeps it: cells by pages, rows from the bottom, one cell
// before and after each row.
struct Mask {
  const int32_t* page;
  Numbers sums, cells;  // (4, pages); target, weight and running sums (6, cells)
  int64_t pages, room;
  int64_t start, W, H;
  double explained;  // a larger residual is more than the mask's kind leaves

  enum Sum { empty, full, weights, masses };

  int64_t end() const { return H * (W + 2); }
  // Where a cell is kept; those out of range are the first one's.
  int64_t place(int64_t cell) const {
    const int64_t at = start + cell, stretch = at >> 6;
    if (stretch < 0 || stretch >= pages) return 0;
    const int64_t here = int64_t(page[stretch]) * 64 + (at & 63);
    return here >= 0 && here < room ? here : 0;
  }
  double target(int64_t place) const { return cells[place]; }
  double weight(int64_t place) const { return cells[room + place]; }
  // What all cells of [from, to) add up to.
  double between(Sum sum, int64_t from, int64_t to) const { return from < to ? before(sum, to) - before(sum, from) : 0; }

 private:
  double before(Sum sum, int64_t cell) const {
    const int64_t stretch = std::clamp((start + cell) >> 6, int64_t(0), pages - 1);
    return sums[sum * pages + stretch] + cells[(2 + sum) * room + place(cell)];
  }
};

// Weighted sums over all pixels; `touched` counts pixels with weight that show an outline,
// `touched_squares` is theirs, `off` counts those whose residual is not explained.
struct Sums {
  double squares = 0, overlap = 0, united = 0, weight = 0, touched = 0, touched_squares = 0, off = 0;
};

// The touched pixels, in raster order, with whether the untouched ones that follow are covered.
struct Touched {
  std::vector<int64_t> cell;
  std::vector<double> coverage;
  std::vector<uint8_t> after;
  bool before = false;  // whether rows begin covered
};

// What lies left of the film has a cell where it covers a row's first pixels other than `before` says.
struct TouchedSink {
  Touched& out;
  int64_t W;

  void begin(bool covered) { out.before = covered; }
  int64_t at(int, int) const { return int64_t(out.cell.size()); }
  void put(int64_t cell, double coverage) {
    out.cell.push_back(cell), out.coverage.push_back(coverage), out.after.push_back(false);
  }
  void pixel(int row, int column, double coverage) { put(row * (W + 2) + column + 1, coverage); }
  void run(int row, int from, int, bool covered) {
    if (from == 0 && covered != out.before) put(row * (W + 2), covered);
    if (covered && !out.cell.empty() && out.cell.back() / (W + 2) == row) out.after.back() = true;
  }
};

// R of a table (its columns, at least as long as they are many), by Householder's reflections.
inline void triangle_of(std::vector<std::vector<double>>& columns, std::vector<double>& R) {
  const size_t k = columns.size(), rows = columns.empty() ? 0 : columns[0].size();
  R.assign(k * k, 0);
  for (size_t j = 0; j < k; ++j) {
    std::vector<double>& v = columns[j];
    double size = 0;
    for (size_t i = j; i < rows; ++i) size = std::max(size, std::abs(v[i]));
    double squares = 0;
    for (size_t i = j; i < rows; ++i) v[i] = ratio(v[i], size), squares += v[i] * v[i];
    const double length = v[j] > 0 ? -std::sqrt(squares) : std::sqrt(squares);
    R[j * k + j] = length * size;
    v[j] -= length;
    const double scale = ratio(1, squares - length * (v[j] + length));  // 2 / |v|^2
    for (size_t c = j + 1; c < k; ++c) {
      std::vector<double>& w = columns[c];
      double along = 0;
      for (size_t i = j; i < rows; ++i) along += v[i] * w[i];
      for (size_t i = j; i < rows; ++i) w[i] -= scale * along * v[i];
      R[j * k + c] = w[j];
    }
  }
}

constexpr double kHidden = 1e-4;  // what shows less of either side shows no outline

class Look {
 public:
  Touched touched;
  Sums sums;
  std::vector<double> weight, residual, rows;  // of touched pixels: (P) each, and derivatives (n, P)
  std::vector<double> triangle;      // R of [J, r], (n + 1, n + 1)

  // `ways` are those in which a fit's moves change what is drawn; `known` are rows (m, n + 1) of [J, r]
  // beside the mask's.
  Look(const Film& film, const Scene& scene, const Mask& mask, const std::vector<Moves>& ways,
       const Numbers& known) {
    TouchedSink sink{touched, mask.W};
    const View view = look(film, scene, sink, true);
    weigh(mask);
    const size_t P = touched.cell.size();
    rows.assign(ways.size() * P, 0);
    for (size_t w = 0; w < ways.size(); ++w) Push(view, scene, ways[w]).add_to(rows.data() + w * P);
    for (size_t w = 0; w < ways.size(); ++w)
      for (size_t p = 0; p < P; ++p) rows[w * P + p] *= std::sqrt(weight[p]);
    reduce(ways.size(), known);
  }

  // Whether a touched pixel has weight and shows the outline. (At a row's ends there is no weight.)
  bool shows(size_t p) const {
    return touched.coverage[p] > kHidden && touched.coverage[p] < 1 - kHidden && weight[p] > 0;
  }

 private:
  void weigh(const Mask& mask) {
    const size_t P = touched.cell.size();
    weight.assign(P, 0), residual.assign(P, 0);
    int64_t from = 0;
    bool covered = touched.before;
    sums.weight = mask.between(Mask::weights, 0, mask.end());
    for (size_t p = 0; p <= P; ++p) {
      const int64_t cell = p < P ? touched.cell[p] : mask.end();
      const int64_t next_row = (from + mask.W + 1) / (mask.W + 2) * (mask.W + 2);
      const int64_t row_end = std::min(next_row, cell);
      add_run(mask, covered, from, row_end);
      add_run(mask, touched.before, row_end, cell);
      if (p < P) add_pixel(mask, p);
      from = cell + 1, covered = p < P && touched.after[p];
    }
    sums.squares = rest_;
    for (double r : residual) sums.squares += r * r;
    sums.united += mask.between(Mask::masses, 0, mask.end()) - sums.overlap;
  }

  void add_run(const Mask& mask, bool covered, int64_t from, int64_t to) {
    rest_ += mask.between(covered ? Mask::full : Mask::empty, from, to);
    if (!covered) return;
    sums.overlap += mask.between(Mask::masses, from, to);
    sums.united += mask.between(Mask::weights, from, to);
  }

  void add_pixel(const Mask& mask, size_t p) {
    const int64_t column = touched.cell[p] % (mask.W + 2);
    if (column == 0 || column > mask.W) return;
    const int64_t place = mask.place(touched.cell[p]);
    const double coverage = touched.coverage[p], target = mask.target(place);
    const double w = weight[p] = mask.weight(place);
    const double r = residual[p] = std::sqrt(w) * (coverage - target);
    sums.overlap += w * std::min(coverage, target);
    sums.united += w * coverage;
    if (!shows(p)) return;
    sums.touched += 1;
    sums.touched_squares += r * r;
    sums.off += std::abs(r) > mask.explained;
  }

  // The untouched pixels' squares are one more row, which moves change in second order alone.
  void reduce(size_t ways, const Numbers& known) {
    const size_t P = touched.cell.size(), more = size_t(known.size) / (ways + 1);
    const size_t length = std::max(P + 1 + more, ways + 1);
    std::vector<std::vector<double>> columns(ways + 1, std::vector<double>(length, 0));
    for (size_t w = 0; w < ways; ++w) std::copy_n(rows.data() + w * P, P, columns[w].data());
    std::copy(residual.begin(), residual.end(), columns[ways].begin());
    columns[ways][P] = std::sqrt(std::max(rest_, 0.0));
    for (size_t k = 0; k < more; ++k)
      for (size_t w = 0; w <= ways; ++w) columns[w][P + 1 + k] = known[int64_t(k * (ways + 1) + w)];
    triangle_of(columns, triangle);
  }

  double rest_ = 0;
};

// --- the outline ----------------------------------------------------------------------------------

constexpr int64_t kReach = 2, kAround = (2 * kReach + 1) * (2 * kReach + 1);

// Of each pixel that shows the outline of a level (W x H): row, column, coverage; and the means over
// the pixels up to `kReach` away each way (nothing beside the level) of how steep coverage is, its
// slopes to the right and up, and its change by each move. Pixel by pixel.
inline std::vector<double> outline_of(const Look& look, int64_t W, int64_t H) {
  struct Near { double steepness = 0, right = 0, up = 0; size_t shown = SIZE_MAX; };
  const Touched& seen = look.touched;
  const size_t P = seen.cell.size(), ways = P ? look.rows.size() / P : 0;
  std::vector<size_t> begin(size_t(H) + 1, P);  // of each row's cells
  for (int64_t row = H, p = int64_t(P); row-- > 0; begin[row] = size_t(p))
    while (p > 0 && seen.cell[p - 1] >= row * (W + 2)) --p;
  const auto covers = [&](int64_t row, int64_t column) -> double {
    row = std::clamp<int64_t>(row, 0, H - 1), column = std::clamp<int64_t>(column, 0, W - 1);
    const int64_t cell = row * (W + 2) + column + 1;
    const auto first = seen.cell.begin() + begin[row], last = seen.cell.begin() + begin[row + 1];
    const auto next = std::upper_bound(first, last, cell);
    if (next == first) return seen.before;
    const size_t k = size_t(next - seen.cell.begin()) - 1;
    return seen.cell[k] == cell ? seen.coverage[k] : seen.after[k];
  };
  const auto span = [](int64_t x, int64_t size) {
    return double(std::max<int64_t>(std::min(x + 1, size - 1) - std::max<int64_t>(x - 1, 0), 1));
  };
  // (What is not written to takes no time.)
  const int64_t width = W + 2 * kReach;
  std::unique_ptr<int32_t, decltype(&std::free)> slots(
      static_cast<int32_t*>(std::calloc(size_t(width * (H + 2 * kReach)), sizeof(int32_t))), &std::free);
  if (!slots) throw std::bad_alloc();
  std::vector<Near> known(1);
  const auto near = [&](int64_t row, int64_t column) -> Near& {
    int32_t& slot = slots.get()[(row + kReach) * width + column + kReach];
    if (slot) return known[slot];
    slot = int32_t(known.size());
    Near n;
    if (row >= 0 && row < H && column >= 0 && column < W) {
      const double right = covers(row, column + 1) - covers(row, column - 1);
      const double up = covers(row + 1, column) - covers(row - 1, column);
      n.right = right / span(column, W), n.up = up / span(row, H), n.steepness = std::hypot(n.right, n.up);
    }
    known.push_back(n);
    return known.back();
  };
  std::vector<size_t> shown;
  for (size_t p = 0; p < P; ++p)
    if (look.shows(p)) shown.push_back(p);
  const auto row = [&](size_t p) { return seen.cell[p] / (W + 2); };
  const auto column = [&](size_t p) { return seen.cell[p] % (W + 2) - 1; };
  std::vector<double> table, changes;
  for (size_t k = 0; k < shown.size(); ++k) {
    const size_t p = shown[k];
    near(row(p), column(p)).shown = k;
    for (size_t w = 0; w < ways; ++w) changes.push_back(look.rows[w * P + p] / std::sqrt(look.weight[p]));
  }
  for (size_t p : shown) {
    std::vector<double> means(3 + ways, 0);
    for (int64_t k = 0; k < kAround; ++k) {
      const Near& n = near(row(p) + k / (2 * kReach + 1) - kReach, column(p) + k % (2 * kReach + 1) - kReach);
      means[0] += n.steepness, means[1] += n.right, means[2] += n.up;
      if (n.shown == SIZE_MAX) continue;
      for (size_t w = 0; w < ways; ++w) means[3 + w] += changes[n.shown * ways + w];
    }
    table.insert(table.end(), {double(row(p)), double(column(p)), seen.coverage[p]});
    for (double sum : means) table.push_back(sum / kAround);
  }
  return table;
}

}  // namespace pinhole
