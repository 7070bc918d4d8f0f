// A tree of boxes over faces and spheres: what rays that pass a box may meet is in it.
//
// Boxes are of floats, four beside one another, about a centre amid the scene. They are larger than
// what is in them by all that their arithmetic rounds, so they never hide what doubles would find.
#pragma once

#include <stdexcept>

#include "geometry.h"

namespace pinhole {

constexpr int kWide = 4;        // children of a node
constexpr int kLeaf = 3;        // primitives of a leaf, at most (4 would fit its number)
constexpr int kBins = 16;       // places along an axis where a node may be split
constexpr int kDeepest = 48;    // levels that are split where it pays; those below, in halves
constexpr int kWaiting = 3 * (kDeepest + 32) + kWide;  // nodes that may wait on the way down
constexpr float kRounding = 0x1p-23f;
constexpr float kSliver = 0x1p-22f;  // a triangle seen edge-on is met so far beside it, over its size
constexpr float kTiny = 1e-29f;

typedef float Four __attribute__((vector_size(16)));
typedef int32_t Four32 __attribute__((vector_size(16)));
inline Four all(float x) { return Four{x, x, x, x}; }
inline Four lesser(Four a, Four b) { return a < b ? a : b; }
inline Four larger(Four a, Four b) { return a > b ? a : b; }
inline Four magnitude(Four a) { return larger(a, -a); }
inline float greatest(Four a) { return std::max(a[0], std::max(a[1], a[2])); }  // of x, y, z
inline float least(Four a) { return std::min(a[0], std::min(a[1], a[2])); }

// What rays may meet: faces, and after them spheres.
template <class Real>
struct Targets {
  const Real* vertices;
  const int32_t* faces;
  const Real* centers;
  const Real* radii;
  int64_t V, F, S;
};

// The x, y, z of a box's two corners.
struct Box {
  Four low = all(INFINITY), high = all(-INFINITY);
  void add(const Box& b) { low = lesser(low, b.low), high = larger(high, b.high); }
  float half_area() const {
    const Four d = high - low;
    return d[0] * d[1] + d[1] * d[2] + d[2] * d[0];
  }
};

// Four children: their boxes' low x, y, z, then high, and for each a node's number, or of a leaf
// ~(4 * its first primitive + how many follow). Where there is no child, the box is empty.
struct alignas(64) Node {
  Four plane[6];
  int32_t child[kWide];
};

// A face's corners as places among the coordinates of all vertices; of a sphere the first is -1.
struct Primitive {
  int32_t id, corner[3];
};

struct Tree {
  double scale = 1;                // boxes are of coordinates in the world times `scale`,
  double centre[3] = {0, 0, 0};    // less the centre
  Box bounds;
  std::vector<Node> nodes;
  std::vector<Primitive> primitives;
};

// What a leaf is made of while the tree is built.
struct Item {
  Box box;
  Four middle;
  int32_t id;
};

// The corners of a primitive's box; false if it is none: not finite, or its vertices do not exist.
template <class Real>
bool extent(const Targets<Real>& t, int64_t id, double* low, double* high) {
  if (id < t.F) {
    for (int k = 0; k < 3; ++k) low[k] = INFINITY, high[k] = -INFINITY;
    for (int c = 0; c < 3; ++c) {
      const int64_t vertex = t.faces[3 * id + c];
      if (vertex < 0 || vertex >= t.V) return false;
      for (int k = 0; k < 3; ++k) {
        const double x = t.vertices[3 * vertex + k];
        if (!std::isfinite(x)) return false;
        low[k] = std::min(low[k], x), high[k] = std::max(high[k], x);
      }
    }
    return true;
  }
  const double radius = t.radii[id - t.F];
  for (int k = 0; k < 3; ++k) {
    const double x = t.centers[3 * (id - t.F) + k];
    low[k] = x - radius, high[k] = x + radius;
    if (!std::isfinite(low[k]) || !std::isfinite(high[k])) return false;
  }
  return radius >= 0;
}

// Sets the tree's unit and centre: the median of some primitives, so that a floor as wide as the
// horizon, or a vertex gone astray, does not take the digits from what stands on it.
template <class Real>
void set_unit(Tree& tree, const Targets<Real>& t) {
  const int64_t number = t.F + t.S, step = number / 256 + 1;
  std::vector<double> some[3];
  double low[3], high[3], most = 0;
  for (int64_t id = 0; id < number; id += step)
    if (extent(t, id, low, high))
      for (int k = 0; k < 3; ++k) some[k].push_back(low[k] / 2 + high[k] / 2);
  for (int k = 0; k < 3 && !some[k].empty(); ++k) {
    const auto median = some[k].begin() + some[k].size() / 2;
    std::nth_element(some[k].begin(), median, some[k].end());
    tree.centre[k] = *median;
  }
  for (int64_t id = 0; id < number; ++id)
    if (extent(t, id, low, high))
      for (int k = 0; k < 3; ++k)
        most = std::max(most, std::max(tree.centre[k] - low[k], high[k] - tree.centre[k]));
  int exponent = 1025;
  if (std::isfinite(most)) std::frexp(most, &exponent);
  tree.scale = std::ldexp(1.0, -std::max(exponent, -1000));
  for (double& x : tree.centre) x *= tree.scale;
}

template <class Real>
std::vector<Item> items_of(const Tree& tree, const Targets<Real>& t) {
  std::vector<Item> items;
  items.reserve(t.F + t.S);
  double low[3], high[3];
  for (int64_t id = 0; id < t.F + t.S; ++id) {
    if (!extent(t, id, low, high)) continue;
    Box b{all(0), all(0)};
    for (int k = 0; k < 3; ++k) {
      b.low[k] = float(low[k] * tree.scale - tree.centre[k]);
      b.high[k] = float(high[k] * tree.scale - tree.centre[k]);
    }
    const Four far = larger(magnitude(b.low), magnitude(b.high));
    const Four more = 4 * kRounding * far + kSliver * (b.high - b.low) + kTiny;
    items.push_back({{b.low - more, b.high + more}, 0.5f * (b.low + b.high), int32_t(id)});
  }
  return items;
}

class Builder {
 public:
  Builder(Tree& tree, std::vector<Item>& items) : tree_(tree), items_(items) {}
  void build() {
    const Part whole = part(0, int(items_.size()));
    tree_.bounds = whole.box;
    tree_.nodes.reserve(items_.size() / 4 + 1);
    add(whole, 0);
  }

 private:
  struct Part {
    int from = 0, to = 0;
    Box box;
    int size() const { return to - from; }
  };
  Part part(int from, int to) const {
    Part p{from, to, {}};
    for (int i = from; i < to; ++i) p.box.add(items_[i].box);
    return p;
  }

  // Adds a node, with all below it: of its parts the one of most surface is split until all are
  // leaves, or four.
  int add(const Part& whole, int depth) {
    Part parts[kWide] = {whole};
    int number = 1;
    while (number < kWide) {
      int next = -1;
      for (int k = 0; k < number; ++k) {
        if (parts[k].size() <= kLeaf) continue;
        if (next < 0 || parts[k].box.half_area() > parts[next].box.half_area()) next = k;
      }
      if (next < 0) break;
      const Part p = parts[next];
      const int middle = split(p, depth);
      parts[next] = part(p.from, middle), parts[number++] = part(middle, p.to);
    }
    const int here = int(tree_.nodes.size());
    Node node;
    for (int k = 0; k < kWide; ++k)
      for (int axis = 0; axis < 3; ++axis) {
        node.plane[axis][k] = parts[k].box.low[axis];
        node.plane[3 + axis][k] = parts[k].box.high[axis];
      }
    tree_.nodes.push_back(node);
    for (int k = 0; k < kWide; ++k) {
      const bool leaf = k >= number || parts[k].size() <= kLeaf;
      const int child = leaf ? ~(4 * parts[k].from + std::max(parts[k].size() - 1, 0)) : add(parts[k], depth + 1);
      tree_.nodes[here].child[k] = child;
    }
    return here;
  }

  // Where the items of a part go apart: where the surfaces of both boxes, each times the number of
  // items in it, are the least in sum (along 16 places of each axis); or in halves.
  int split(const Part& p, int depth) {
    Item *begin = items_.data() + p.from, *end = items_.data() + p.to;
    Box middles;
    for (Item* i = begin; i < end; ++i) middles.add({i->middle, i->middle});
    const Four width = middles.high - middles.low;
    const Four per = width > all(0) ? kBins * (1 - 1e-5f) / width : all(0);
    const auto bins = [&](const Item& i) { return __builtin_convertvector((i.middle - middles.low) * per, Four32); };
    int axis = width[1] > width[0], cut = 0;
    axis = width[2] > width[axis] ? 2 : axis;
    if (depth < kDeepest) {
      Box boxes[3][kBins];
      int numbers[3][kBins] = {};
      for (Item* i = begin; i < end; ++i) {
        const Four32 bin = bins(*i);
        for (int k = 0; k < 3; ++k) ++numbers[k][bin[k]], boxes[k][bin[k]].add(i->box);
      }
      float lowest = INFINITY;
      for (int k = 0; k < 3; ++k) {
        float above[kBins];
        Box box;
        int number = 0;
        for (int b = kBins; b-- > 1;) {
          box.add(boxes[k][b]), number += numbers[k][b];
          above[b] = number ? number * box.half_area() : 0;
        }
        box = {}, number = 0;
        for (int b = 1; b < kBins; ++b) {
          box.add(boxes[k][b - 1]), number += numbers[k][b - 1];
          if (number == 0 || number == p.size()) continue;
          const float cost = number * box.half_area() + above[b];
          if (cost < lowest) lowest = cost, axis = k, cut = b;
        }
      }
    }
    if (cut > 0) return int(std::partition(begin, end, [&](const Item& i) { return bins(i)[axis] < cut; }) - items_.data());
    Item* half = begin + p.size() / 2;
    std::nth_element(begin, half, end, [&](const Item& a, const Item& b) { return a.middle[axis] < b.middle[axis]; });
    return int(half - items_.data());
  }

  Tree& tree_;
  std::vector<Item>& items_;
};

template <class Real>
Tree tree_of(const Targets<Real>& t) {
  if (t.F + t.S > INT32_MAX / 8 || t.V > INT32_MAX / 4) throw std::length_error("too many faces for a tree");
  Tree tree;
  set_unit(tree, t);
  std::vector<Item> items = items_of(tree, t);
  if (items.empty()) return tree;
  Builder(tree, items).build();
  tree.primitives.reserve(items.size());
  for (const Item& i : items) {
    Primitive p{i.id, {-1, -1, -1}};
    for (int c = 0; c < 3 && i.id < t.F; ++c) p.corner[c] = 3 * t.faces[3 * int64_t(i.id) + c];
    tree.primitives.push_back(p);
  }
  return tree;
}

}  // namespace pinhole
