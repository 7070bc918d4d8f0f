// The calls that JAX makes (`jax.ffi`), each of one view or a batch: a silhouette (`image`), or the
// pixels alone that its outline touches (`touch`); their push and pull.
#include "frames.h"
#include "motion.h"

#ifdef _WIN32
#define PINHOLE_HANDLER extern "C" __declspec(dllexport)
#else
#define PINHOLE_HANDLER extern "C" __attribute__((visibility("default")))
#endif

namespace {

using namespace pinhole;

bool finite(const Numbers& n) {
  for (int64_t k = 0; k < n.size; ++k)
    if (!std::isfinite(n[k])) return false;
  return true;
}

template <class T>
T* data_of(const Array& a, int64_t member) {
  return static_cast<T*>(a.buffer->data) + a.size() * member;
}

// What each view is of: film (18), lens (n), vertices (V, 3), faces (F, 3), the edges' vertices and
// faces (E, 2), centres (S, 3), radii (S), frames (S, 9), and the film's size W, H (2).
constexpr int kGiven = 10;
constexpr int64_t kOwn[kGiven] = {1, 1, 2, 2, 2, 2, 2, 1, 2, 1};

class Views {
 public:
  explicit Views(const XLA_FFI_CallFrame* frame) : model_(Model(attribute(frame, "model"))) {
    for (int k = 0; k < kGiven; ++k) given_[k] = argument(frame, k, kOwn[k]);
  }

  // Goes to a member of a batch; false if it is of the same view as the last one.
  bool find(const Batch& batch, int64_t member) {
    std::vector<int64_t> entries(kGiven);
    for (int k = 0; k < kGiven; ++k) entries[k] = batch.entry(given_[k], member);
    if (entries == entries_) return false;
    entries_ = entries;
    scene.mesh = {numbers(2), integers(3), integers(4), integers(5), given_[2].length(0), given_[3].length(0), given_[4].length(0)};
    scene.spheres = {numbers(6), numbers(7), numbers(8), given_[6].length(0)};
    W = integers(9)[0], H = integers(9)[1];
    return true;
  }

  // Draws it. What is not of finite numbers is an empty view.
  template <class Sink>
  View draw(Sink& sink, bool with_seen) const {
    const Numbers film = numbers(0), lens = numbers(1);
    const bool sound = finite(film) && finite(lens) && finite(scene.mesh.vertices) &&
                       finite(scene.spheres.frames) && finite(scene.spheres.centers) && finite(scene.spheres.radii);
    const Scene nothing{};
    Film f = sound ? film_of(film, lens, model_, W, H) : Film();
    f.W = W, f.H = H;
    return look(f, sound ? scene : nothing, sink, with_seen);
  }

  Scene scene;
  int W = 0, H = 0;

 private:
  Numbers numbers(int k) const { return given_[k].numbers(entries_[k]); }
  const int32_t* integers(int k) const { return given_[k].integers(entries_[k]); }

  Array given_[kGiven];
  std::vector<int64_t> entries_;
  Model model_;
};

// Touched pixels, in raster order from the bottom, as far as there is room: each with its coverage,
// and whether the untouched ones after it are covered. A row has one cell more at either end: what
// lies left of the film has one where it covers the row's first pixels other than `begin` tells.
template <class Real>
struct TouchSink {
  int64_t W, room;
  int32_t* cell;
  Real* coverage;
  bool* after;
  int64_t count = 0;
  bool covers_first = false;

  void begin(bool covered) { covers_first = covered; }
  int64_t at(int, int) const { return count < room ? count : -1; }
  void put(int64_t where, double value) {
    if (count < room) cell[count] = int32_t(where), coverage[count] = Real(value), after[count] = false;
    ++count;
  }
  void pixel(int row, int column, double value) { put(row * (W + 2) + column + 1, value); }
  void run(int row, int from, int, bool covered) {
    if (from == 0 && covered != covers_first) put(row * (W + 2), covered);
    const int64_t last = count - 1;
    if (covered && last >= 0 && last < room && cell[last] / (W + 2) == row) after[last] = true;
  }
};

// --- what is drawn --------------------------------------------------------------------------------

template <class Real>
void draw_images(XLA_FFI_CallFrame* frame) {
  Views views(frame);
  const Array out = result(frame, 0, 2);
  const Batch batch(out);
  for (int64_t k = 0; k < batch.size; ++k) {
    views.find(batch, k);
    ImageSink<Real> sink{data_of<Real>(out, k), views.W, views.H};
    views.draw(sink, false);
  }
}

template <class Real>
void draw_touched(XLA_FFI_CallFrame* frame) {
  Views views(frame);
  const Array cell = result(frame, 0, 1), coverage = result(frame, 1, 1), after = result(frame, 2, 1);
  const Array facts = result(frame, 3, 1);  // how many were touched; whether rows begin covered
  const Batch batch(cell);
  for (int64_t k = 0; k < batch.size; ++k) {
    views.find(batch, k);
    TouchSink<Real> sink{views.W, cell.size(), data_of<int32_t>(cell, k), data_of<Real>(coverage, k), data_of<bool>(after, k)};
    views.draw(sink, false);
    data_of<int32_t>(facts, k)[0] = int32_t(sink.count);
    while (sink.count < sink.room) sink.put((views.W + 2) * int64_t(views.H), 0);
    data_of<int32_t>(facts, k)[1] = sink.covers_first;
  }
}

// --- how it changes -------------------------------------------------------------------------------

// What is seen in a view, by pixels of an image, or by touched pixels where there is `room` for some.
template <class Real>
View seen_in(const Views& views, bool whole, int64_t room) {
  if (whole) {
    std::vector<Real> image(int64_t(views.W) * views.H);
    ImageSink<Real> sink{image.data(), views.W, views.H};
    return views.draw(sink, true);
  }
  std::vector<int32_t> cell(room);
  std::vector<Real> coverage(room);
  std::vector<uint8_t> after(room);
  TouchSink<Real> sink{views.W, room, cell.data(), coverage.data(), reinterpret_cast<bool*>(after.data())};
  return views.draw(sink, true);
}

// What moves, after what is given: film, lens, vertices, frames.
constexpr int64_t kMovingOwn[4] = {1, 1, 2, 2};

template <class Real>
void push_all(XLA_FFI_CallFrame* frame, bool whole) {
  Views views(frame);
  const Array out = result(frame, 0, whole ? 2 : 1);
  const Batch batch(out);
  std::fill_n(data_of<Real>(out, 0), out.size() * batch.size, Real(0));
  View view;
  for (int64_t member = 0; member < batch.size; ++member) {
    if (views.find(batch, member)) view = seen_in<Real>(views, whole, out.size());
    const auto moving = [&](int k) {
      const Array a = argument(frame, kGiven + k, kMovingOwn[k]);
      return a.numbers(batch.entry(a, member));
    };
    const Moves moves{moving(0), moving(1), moving(2), moving(3)};
    Push(view, views.scene, moves).add_to(data_of<Real>(out, member));
  }
}

template <class Real>
void pull_all(XLA_FFI_CallFrame* frame, bool whole) {
  Views views(frame);
  const Batch batch(result(frame, 0, kMovingOwn[0]));
  const Array weights = argument(frame, kGiven, whole ? 2 : 1);
  View view;
  for (int64_t member = 0; member < batch.size; ++member) {
    if (views.find(batch, member)) view = seen_in<Real>(views, whole, weights.size());
    Array out[4];
    for (int k = 0; k < 4; ++k) out[k] = result(frame, k, kMovingOwn[k]);
    Gains gains;
    gains.wants_vertices = out[2].size() > 0, gains.wants_frames = out[3].size() > 0;
    Pull(view, views.scene, gains).add(weights.numbers(batch.entry(weights, member)));
    const std::vector<double>* sums[4] = {&gains.film, &gains.lens, &gains.vertices, &gains.frames};
    for (int k = 0; k < 4; ++k) std::copy_n(sums[k]->begin(), out[k].size(), data_of<Real>(out[k], member));
  }
}

bool is_single(const XLA_FFI_CallFrame* frame) { return argument(frame, 0, 1).single(); }

}  // namespace

#define PINHOLE_CALL(name, body, ...)                                                        \
  PINHOLE_HANDLER XLA_FFI_Error* name(XLA_FFI_CallFrame* frame) {                            \
    return guarded(frame, [&] {                                                              \
      is_single(frame) ? body<float>(frame __VA_ARGS__) : body<double>(frame __VA_ARGS__);   \
    });                                                                                      \
  }

PINHOLE_CALL(pinhole_image, draw_images)
PINHOLE_CALL(pinhole_image_push, push_all, , true)
PINHOLE_CALL(pinhole_image_pull, pull_all, , true)
PINHOLE_CALL(pinhole_touch, draw_touched)
PINHOLE_CALL(pinhole_touch_push, push_all, , false)
PINHOLE_CALL(pinhole_touch_pull, pull_all, , false)
