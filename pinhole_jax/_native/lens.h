// How a lens bends the image: OpenCV's models, as `_camera/distortion.py` has them.
#pragma once

#include "geometry.h"

namespace pinhole {

inline double number(double x) { return x; }
inline double root(double x) { return std::sqrt(x); }
inline double arctan(double x) { return std::atan(x); }

// A number and its derivatives in N directions; T may be one itself.
template <class T, int N>
struct Dual {
  T value{};
  T slope[N] = {};
  Dual() = default;
  Dual(double v) : value(v) {}
  Dual(T v, int k, T d) : value(v) { slope[k] = d; }

  friend double number(const Dual& x) { return number(x.value); }
  friend Dual operator+(const Dual& a, const Dual& b) { return chain(a.value + b.value, a, 1.0, b, 1.0); }
  friend Dual operator-(const Dual& a, const Dual& b) { return chain(a.value - b.value, a, 1.0, b, -1.0); }
  friend Dual operator*(const Dual& a, const Dual& b) { return chain(a.value * b.value, a, b.value, b, a.value); }
  friend Dual operator/(const Dual& a, const Dual& b) {
    const T q = a.value / b.value, by = 1.0 / b.value;
    return chain(q, a, by, b, 0.0 - q * by);
  }
  friend Dual root(const Dual& x) {
    const T s = root(x.value);
    return chain(s, x, 0.5 / s);
  }
  friend Dual arctan(const Dual& x) { return chain(arctan(x.value), x, 1.0 / (1.0 + x.value * x.value)); }

 private:
  // value and the derivatives a.slope * by_a + b.slope * by_b
  static Dual chain(T value, const Dual& a, T by_a) {
    Dual r;
    r.value = value;
    for (int k = 0; k < N; ++k) r.slope[k] = a.slope[k] * by_a;
    return r;
  }
  static Dual chain(T value, const Dual& a, T by_a, const Dual& b, T by_b) {
    Dual r;
    r.value = value;
    for (int k = 0; k < N; ++k) r.slope[k] = a.slope[k] * by_a + b.slope[k] * by_b;
    return r;
  }
};

enum class Model : int { none = 0, brown_conrady = 1, rational = 2, fisheye = 3 };
constexpr int kMostNumbers = 12;  // coefficients, focal lengths, principal point

inline int coefficients_of(Model m) {
  return m == Model::brown_conrady ? 5 : m == Model::rational ? 8 : m == Model::fisheye ? 4 : 0;
}

struct Lens {
  Model model = Model::none;
  double numbers[kMostNumbers] = {};  // coefficients, then fx, fy, cx, cy
  double trusted = 0;                 // radius of the ideal image up to which the formula counts
  int size() const { return coefficients_of(model) + 4; }
};

template <class T> struct Pair {
  T x, y;
};

// The formula, in normalised coordinates (y up); `k` are the coefficients in OpenCV's order.
template <class T>
Pair<T> distorted(Model model, const T* k, const T& x, const T& y) {
  const T s = x * x + y * y;
  if (model == Model::fisheye) {
    T square, over;  // theta squared, and theta over radius: by series where a quotient is lost
    if (number(s) < 1e-4) {
      square = s * (1.0 - s * (2.0 / 3 - s * (23.0 / 45 - s * (44.0 / 105))));
      over = 1.0 - s * (1.0 / 3 - s * (0.2 - s * (1.0 / 7 - s * (1.0 / 9))));
    } else {
      const T radius = root(s), theta = arctan(radius);
      square = theta * theta, over = theta / radius;
    }
    const T stretch = 1.0 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])));
    return {x * stretch * over, y * stretch * over};
  }
  T radial = 1.0 + s * (k[0] + s * (k[1] + s * k[4]));
  if (model == Model::rational) radial = radial / (1.0 + s * (k[5] + s * (k[6] + s * k[7])));
  const T two_xy = 2.0 * x * y;
  return {x * radial - k[2] * two_xy + k[3] * (s + 2.0 * x * x),
          y * radial - k[2] * (s + 2.0 * y * y) + k[3] * two_xy};
}

// The same up to the trusted radius, and beyond it straight on.
template <class T>
Pair<T> continued(const Lens& lens, const T* k, const T& x, const T& y) {
  const double nx = number(x), ny = number(y);
  if (nx * nx + ny * ny <= lens.trusted * lens.trusted) return distorted(lens.model, k, x, y);
  using D = Dual<T, 1>;
  const T share = lens.trusted / root(x * x + y * y);
  const T inner_x = x * share, inner_y = y * share;
  D kd[kMostNumbers];
  for (int n = 0; n < coefficients_of(lens.model); ++n) kd[n] = D(k[n], 0, 0.0);
  const auto image = distorted(lens.model, kd, D(inner_x, 0, x - inner_x), D(inner_y, 0, y - inner_y));
  return {image.x.value + image.x.slope[0], image.y.value + image.y.slope[0]};
}

// The film point (px) of an ideal one.
inline Vec2 bent(const Lens& lens, Vec2 p) {
  if (lens.model == Model::none) return p;
  const double* f = lens.numbers + coefficients_of(lens.model);
  const auto q = continued(lens, lens.numbers, (p.x - f[2]) / f[0], (p.y - f[3]) / f[1]);
  return {f[0] * q.x + f[2], f[1] * q.y + f[3]};
}

// The derivatives of a film point: by the ideal point's two numbers, then by the lens's.
struct BentSlopes {
  double x[2 + kMostNumbers], y[2 + kMostNumbers];
};
inline BentSlopes bent_slopes(const Lens& lens, Vec2 p) {
  constexpr int N = 2 + kMostNumbers;
  using D = Dual<double, N>;
  const int n = coefficients_of(lens.model);
  D k[kMostNumbers];
  for (int i = 0; i < n + 4; ++i) k[i] = D(lens.numbers[i], 2 + i, 1.0);
  const D x(p.x, 0, 1.0), y(p.y, 1, 1.0);
  const D *f = k + n, *c = k + n + 2;
  const auto q = continued(lens, k, (x - c[0]) / f[0], (y - c[1]) / f[1]);
  const D u = f[0] * q.x + c[0], v = f[1] * q.y + c[1];
  BentSlopes s;
  std::copy(u.slope, u.slope + N, s.x);
  std::copy(v.slope, v.slope + N, s.y);
  return s;
}

// An ideal rectangle (left, right, low, high) around the film: the first of ever larger ones whose
// sides are all seen beyond the same side of the film.
inline void ideal_bounds(const Lens& lens, int W, int H, double bounds[4]) {
  const double* f = lens.numbers + coefficients_of(lens.model);
  const double ends[4] = {-f[2] / f[0], (W - f[2]) / f[0], -f[3] / f[1], (H - f[3]) / f[1]};
  const double out[4] = {-1, 1, -1, 1};
  double size = 0, box[4];
  for (double e : ends) size = std::max(size, std::abs(e));
  const auto sees_all = [&](double scale) {
    for (int k = 0; k < 4; ++k) box[k] = out[k] * scale * std::max(out[k] * ends[k], size / 10);
    for (int n = 0; n <= 32; ++n) {
      const double t = n / 32.0, x = box[0] + t * (box[1] - box[0]), y = box[2] + t * (box[3] - box[2]);
      const double xs[4] = {box[0], box[1], x, x}, ys[4] = {y, y, box[2], box[3]};
      for (int k = 0; k < 4; ++k) {
        const auto q = continued(lens, lens.numbers, xs[k], ys[k]);
        if (!(out[k] * ((k < 2 ? q.x : q.y) - ends[k]) > size / 50)) return false;
      }
    }
    return true;
  };
  for (int k = 0; k < 96; ++k)
    if (sees_all(1.02 * std::pow(600 / 1.02, k / 95.0))) break;
  for (int k = 0; k < 4; ++k) bounds[k] = box[k] * f[k / 2] + f[2 + k / 2];
}

}  // namespace pinhole
