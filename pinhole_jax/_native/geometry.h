// Small vectors, the film, and a lens. Lengths on the film are in pixels, y up.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace pinhole {

struct Vec2 {
  double x = 0, y = 0;
  double operator[](int axis) const { return axis ? y : x; }
};
inline Vec2 operator+(Vec2 a, Vec2 b) { return {a.x + b.x, a.y + b.y}; }
inline Vec2 operator-(Vec2 a, Vec2 b) { return {a.x - b.x, a.y - b.y}; }
inline Vec2 operator*(double s, Vec2 a) { return {s * a.x, s * a.y}; }

inline double norm(Vec2 a) { return std::hypot(a.x, a.y); }

struct Vec3 {
  double x = 0, y = 0, z = 0;
  double operator[](int axis) const { return axis == 0 ? x : axis == 1 ? y : z; }
};
inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double largest(Vec3 a) {
  return std::max(std::abs(a.x), std::max(std::abs(a.y), std::abs(a.z)));
}

// 0 where the denominator is 0.
inline double ratio(double numerator, double denominator) {
  return denominator != 0 ? numerator / denominator : 0;
}

// Read-only numbers of either float type, read as doubles.
struct Numbers {
  const void* data = nullptr;
  bool single = false;
  int64_t size = 0;
  double operator[](int64_t k) const {
    return single ? static_cast<const float*>(data)[k] : static_cast<const double*>(data)[k];
  }
  Vec3 point(int64_t row) const {
    return {(*this)[3 * row], (*this)[3 * row + 1], (*this)[3 * row + 2]};
  }
  Numbers from(int64_t k, int64_t n) const {
    const auto* bytes = static_cast<const char*>(data);
    return {bytes + k * (single ? 4 : 8), single, n};
  }
};

}  // namespace pinhole
