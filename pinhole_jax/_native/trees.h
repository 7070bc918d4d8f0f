// Trees of the scenes that were last walked through, by what these hold: equal arrays, one tree.
#pragma once

#include <cstring>
#include <list>
#include <memory>
#include <mutex>

#include "tree.h"

namespace pinhole {

constexpr size_t kMostTrees = 4;
constexpr size_t kMostBytes = size_t(1) << 28;  // a larger scene's tree is made for each call

struct KeptTree {
  std::vector<char> scene;
  std::shared_ptr<const Tree> tree;
};

// The arrays of a scene, as they are in memory, after their lengths.
template <class Real>
struct SceneBytes {
  struct Piece {
    const void* data;
    size_t size;
  };
  int64_t lengths[4];
  Piece pieces[5];

  explicit SceneBytes(const Targets<Real>& t)
      : lengths{int64_t(sizeof(Real)), t.V, t.F, t.S},
        pieces{{lengths, sizeof lengths},
               {t.vertices, 3 * t.V * sizeof(Real)},
               {t.faces, 3 * t.F * sizeof(int32_t)},
               {t.centers, 3 * t.S * sizeof(Real)},
               {t.radii, t.S * sizeof(Real)}} {}
  SceneBytes(const SceneBytes&) = delete;
  size_t size() const {
    size_t n = 0;
    for (const Piece& p : pieces) n += p.size;
    return n;
  }
  bool equal(const std::vector<char>& kept) const {
    if (kept.size() != size()) return false;
    const char* at = kept.data();
    for (const Piece& p : pieces) {
      if (p.size && std::memcmp(at, p.data, p.size) != 0) return false;
      at += p.size;
    }
    return true;
  }
  std::vector<char> copy() const {
    std::vector<char> bytes;
    bytes.reserve(size());
    for (const Piece& p : pieces) bytes.insert(bytes.end(), static_cast<const char*>(p.data), static_cast<const char*>(p.data) + p.size);
    return bytes;
  }
};

inline size_t size_of(const Tree& t) {
  return t.nodes.size() * sizeof(Node) + t.primitives.size() * sizeof(Primitive);
}

// A scene's tree: one that was kept, or a new one, which the oldest makes room for.
template <class Real>
std::shared_ptr<const Tree> kept_tree(const Targets<Real>& targets) {
  static std::mutex& mutex = *new std::mutex;  // (a call may outlast what is static)
  static std::list<KeptTree>& kept = *new std::list<KeptTree>;
  const SceneBytes<Real> scene(targets);
  {
    const std::lock_guard<std::mutex> lock(mutex);
    for (auto k = kept.begin(); k != kept.end(); ++k) {
      if (!scene.equal(k->scene)) continue;
      kept.splice(kept.begin(), kept, k);
      return k->tree;
    }
  }
  auto tree = std::make_shared<const Tree>(tree_of(targets));
  if (size_of(*tree) + scene.size() > kMostBytes / kMostTrees) return tree;
  KeptTree entry{scene.copy(), tree};
  const std::lock_guard<std::mutex> lock(mutex);
  kept.push_front(std::move(entry));
  if (kept.size() > kMostTrees) kept.pop_back();
  return tree;
}

}  // namespace pinhole
