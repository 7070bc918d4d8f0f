// Trees of the scenes that were last walked through, by what these hold: equal arrays, one tree.
#pragma once

#include <array>
#include <list>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>

#include "tree.h"

namespace pinhole {

constexpr size_t kMostTrees = 4;
constexpr size_t kMostBytes = size_t(1) << 28;  // a larger scene's tree is made for each call

struct KeptTree {
  size_t real;  // bytes of a coordinate
  std::vector<std::string> scene;
  std::shared_ptr<const Tree> tree;
};

// The arrays of a scene, as they are in memory.
template <class Real>
std::array<std::string_view, 4> bytes_of(const Targets<Real>& t) {
  const auto bytes = [](const auto* data, int64_t size) {
    return std::string_view(reinterpret_cast<const char*>(data), size * sizeof *data);
  };
  return {bytes(t.vertices, 3 * t.V), bytes(t.faces, 3 * t.F), bytes(t.centers, 3 * t.S), bytes(t.radii, t.S)};
}

// A scene's tree: one that was kept, or a new one, which the oldest makes room for.
template <class Real>
std::shared_ptr<const Tree> kept_tree(const Targets<Real>& targets) {
  static std::mutex& mutex = *new std::mutex;  // (a call may outlast what is static)
  static std::list<KeptTree>& kept = *new std::list<KeptTree>;
  const auto scene = bytes_of(targets);
  {
    const std::lock_guard<std::mutex> lock(mutex);
    for (auto k = kept.begin(); k != kept.end(); ++k) {
      if (k->real != sizeof(Real) || !std::equal(scene.begin(), scene.end(), k->scene.begin())) continue;
      kept.splice(kept.begin(), kept, k);
      return k->tree;
    }
  }
  auto tree = std::make_shared<const Tree>(tree_of(targets));
  size_t size = tree->nodes.size() * sizeof(Node) + tree->primitives.size() * sizeof(Primitive);
  for (const std::string_view bytes : scene) size += bytes.size();
  if (size > kMostBytes / kMostTrees) return tree;
  KeptTree entry{sizeof(Real), {scene.begin(), scene.end()}, tree};
  const std::lock_guard<std::mutex> lock(mutex);
  kept.push_front(std::move(entry));
  if (kept.size() > kMostTrees) kept.pop_back();
  return tree;
}

}  // namespace pinhole
