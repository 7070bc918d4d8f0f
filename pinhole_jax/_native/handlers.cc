// The calls that JAX makes (`jax.ffi`): a silhouette (`image`) of one view or a batch, its push and
// pull; a fit's `look`; what rays meet (`walk`). And those that Python makes for tables of a look, by
// `ctypes`.
#include "frames.h"
#include "look.h"
#include "trees.h"
#include "walk.h"

#ifdef _WIN32
#define PINHOLE_HANDLER extern "C" __declspec(dllexport)
#else
#define PINHOLE_HANDLER extern "C" __attribute__((visibility("default")))
#endif

namespace {

using namespace pinhole;

template <class Real>
bool finite(const Real* numbers, int64_t size) {
  int some = 0;  // (Without a branch, several are compared at once.)
  for (int64_t k = 0; k < size; ++k) some |= !(std::abs(numbers[k]) <= std::numeric_limits<Real>::max());
  return !some;
}
bool finite(const Numbers& n) {
  return n.single ? finite(static_cast<const float*>(n.data), n.size)
                  : finite(static_cast<const double*>(n.data), n.size);
}

template <class T>
T* data_of(const Array& a, int64_t member) {
  return static_cast<T*>(a.buffer->data) + a.size() * member;
}

// What each view is of: film (18), lens (n), vertices (V, 3), frames (S, 9), faces (F, 3), the edges'
// vertices and faces (E, 2), centres (S, 3), radii (S), and the film's size W, H (2).
constexpr int kGiven = 10;
constexpr int64_t kOwn[kGiven] = {1, 1, 2, 2, 2, 2, 2, 2, 1, 1};

class Views {
 public:
  Views(void* const* arguments, int64_t model) : model_(Model(model)) {
    for (int k = 0; k < kGiven; ++k) given_[k] = array(arguments[k], kOwn[k]);
  }
  explicit Views(const XLA_FFI_CallFrame* frame) : Views(frame->args.args, attribute(frame, "model")) {}

  // Goes to a member of a batch; false if it is of the same view as the last one.
  bool find(const Batch& batch, int64_t member) {
    std::vector<int64_t> entries(kGiven);
    for (int k = 0; k < kGiven; ++k) entries[k] = batch.entry(given_[k], member);
    if (entries == entries_) return false;
    entries_ = entries;
    const MeshData filled{numbers(2), integers(4), integers(5), integers(6), given_[2].length(0), given_[4].length(0), given_[5].length(0)};
    scene.mesh = filled.without_padding();
    scene.spheres = {numbers(7), numbers(8), numbers(3), given_[7].length(0)};
    W = integers(9)[0], H = integers(9)[1];
    sound_ = finite(numbers(0)) && finite(numbers(1)) && finite(scene.mesh.vertices) &&
             finite(scene.spheres.frames) && finite(scene.spheres.centers) && finite(scene.spheres.radii);
    return true;
  }

  // What is not of finite numbers is an empty view.
  Film film() const { return sound_ ? film_of(numbers(0), numbers(1), model_, W, H) : Film{{}, {}, {}, {}, W, H}; }
  Scene seen_scene() const { return sound_ ? scene : Scene{}; }

  template <class Sink>
  View draw(Sink& sink, bool with_seen, const ContourEdges* known = nullptr) const {
    return look(film(), seen_scene(), sink, with_seen, known);
  }

  Scene scene;
  int W = 0, H = 0;

 private:
  Numbers numbers(int k) const { return given_[k].numbers(entries_[k]); }
  const int32_t* integers(int k) const { return given_[k].integers(entries_[k]); }

  Array given_[kGiven];
  std::vector<int64_t> entries_;
  Model model_;
  bool sound_ = false;
};

// --- what is drawn --------------------------------------------------------------------------------

// Which edges are contour, from an image to its derivative: which of a large mesh are takes most of
// the time. Their number (-1: there is no room), whether the mesh is closed, the layers on the left.
constexpr int64_t kFacts = 3;

void write(const ContourEdges& contour, int32_t* record, int64_t size) {
  const int64_t number = int64_t(contour.edges.size());
  record[0] = number + kFacts <= size ? int32_t(number) : -1;
  record[1] = contour.closed, record[2] = contour.base;
  if (record[0] >= 0) std::copy(contour.edges.begin(), contour.edges.end(), record + kFacts);
}
bool read(const int32_t* record, int64_t size, ContourEdges& contour) {
  if (record[0] < 0 || record[0] > size - kFacts) return false;
  contour = {{record + kFacts, record + kFacts + record[0]}, record[1] != 0, record[2]};
  return true;
}

// An image; of a call with two results also which edges are contour.
template <class Real>
void draw_images(XLA_FFI_CallFrame* frame) {
  Views views(frame);
  const Array out = result(frame, 0, 2);
  const Batch batch(out);
  for (int64_t k = 0; k < batch.size; ++k) {
    views.find(batch, k);
    ImageSink<Real> sink{data_of<Real>(out, k), views.W, views.H};
    const View view = views.draw(sink, false);
    if (frame->rets.size < 2) continue;
    const Array record = result(frame, 1, 1);
    write(view.contour, data_of<int32_t>(record, k), record.size());
  }
}

// --- how it changes -------------------------------------------------------------------------------

// What is seen of a member of a batch, whose contour's edges follow what is given.
template <class Real>
View seen_in(const XLA_FFI_CallFrame* frame, const Views& views, const Batch& batch, int64_t member) {
  std::vector<Real> image(int64_t(views.W) * views.H);
  ImageSink<Real> sink{image.data(), views.W, views.H};
  const Array record = argument(frame, kGiven, 1);
  ContourEdges known;
  const bool is_known = read(record.integers(batch.entry(record, member)), record.size(), known);
  return views.draw(sink, true, is_known ? &known : nullptr);
}

// What moves, after these: film, lens, vertices, frames.
constexpr int kMoving = kGiven + 1;
constexpr int64_t kMovingOwn[4] = {1, 1, 2, 2};

template <class Real>
void push_all(XLA_FFI_CallFrame* frame) {
  Views views(frame);
  const Array out = result(frame, 0, 2);
  const Batch batch(out);
  std::fill_n(data_of<Real>(out, 0), out.size() * batch.size, Real(0));
  View view;
  for (int64_t member = 0; member < batch.size; ++member) {
    if (views.find(batch, member)) view = seen_in<Real>(frame, views, batch, member);
    const auto moving = [&](int k) {
      const Array a = argument(frame, kMoving + k, kMovingOwn[k]);
      return a.numbers(batch.entry(a, member));
    };
    const Moves moves{moving(0), moving(1), moving(2), moving(3)};
    Push(view, views.scene, moves).add_to(data_of<Real>(out, member));
  }
}

template <class Real>
void pull_all(XLA_FFI_CallFrame* frame) {
  Views views(frame);
  const Batch batch(result(frame, 0, kMovingOwn[0]));
  const Array weights = argument(frame, kMoving, 2);
  View view;
  for (int64_t member = 0; member < batch.size; ++member) {
    if (views.find(batch, member)) view = seen_in<Real>(frame, views, batch, member);
    Array out[4];
    for (int k = 0; k < 4; ++k) out[k] = result(frame, k, kMovingOwn[k]);
    Gains gains;
    gains.wants_vertices = out[2].size() > 0, gains.wants_frames = out[3].size() > 0;
    Pull(view, views.scene, gains).add(weights.numbers(batch.entry(weights, member)));
    const std::vector<double>* sums[4] = {&gains.film, &gains.lens, &gains.vertices, &gains.frames};
    for (int k = 0; k < 4; ++k) {
      Real* const to = data_of<Real>(out[k], member);
      const int64_t size = std::min(out[k].size(), int64_t(sums[k]->size()));
      std::fill(std::copy_n(sums[k]->begin(), size, to), to + out[k].size(), Real(0));
    }
  }
}

// --- looks ----------------------------------------------------------------------------------------

// After what is given: how the film (n, 18), the lens (n, l), vertices (n, V, 3; or none, n, 0, 3) and
// the frames (n, S, 9) move, where the level starts (1), what residual is explained (1), the mask's
// pages (Q), sums (4, Q) and cells (6, N), and rows known beside it (m, n + 1).

Look look_of(void* const* arguments, int64_t model) {
  Views views(arguments, model);
  views.find(Batch(), 0);
  const auto own = [&](int k, int64_t axes) { return array(arguments[kGiven + k], axes); };
  const Array film = own(0, 2), lens = own(1, 2), vertices = own(2, 3), frames = own(3, 3);
  const Array page = own(6, 1), cells = own(8, 2);
  std::vector<Moves> ways(film.length(0));
  const auto way = [&](const Array& a, size_t w) {
    const int64_t size = a.size() / std::max(a.length(0), int64_t(1));
    return a.numbers(0).from(size * int64_t(w), size);
  };
  for (size_t w = 0; w < ways.size(); ++w) ways[w] = {way(film, w), way(lens, w), way(vertices, w), way(frames, w)};
  const Mask mask{page.integers(0), own(7, 2).numbers(0), cells.numbers(0), page.size(), cells.length(1),
                  own(4, 1).integers(0)[0], views.W, views.H, own(5, 1).numbers(0)[0]};
  return Look(views.film(), views.seen_scene(), mask, ways, own(9, 2).numbers(0));
}

template <class Real>
void take_look(XLA_FFI_CallFrame* frame) {
  const Look look = look_of(frame->args.args, attribute(frame, "model"));
  std::copy(look.triangle.begin(), look.triangle.end(), data_of<Real>(result(frame, 0, 2), 0));
  const Sums& s = look.sums;
  const double sums[] = {s.squares, s.overlap, s.united, s.weight, s.touched, s.touched_squares, s.off};
  std::copy(std::begin(sums), std::end(sums), data_of<Real>(result(frame, 1, 1), 0));
}

// --- what rays meet -------------------------------------------------------------------------------

// Vertices (V, 3), faces (F, 3), centres (S, 3), radii (S); origins (N or 1, 3), directions (N, 3).
constexpr int64_t kRaysOwn[6] = {2, 2, 2, 1, 2, 2};

template <class Real>
void walk_all(XLA_FFI_CallFrame* frame) {
  Array given[6];
  for (int k = 0; k < 6; ++k) given[k] = argument(frame, k, kRaysOwn[k]);
  const Array out = result(frame, 0, 1);
  const Batch batch(out);
  const bool any = attribute(frame, "any") != 0;
  for (int64_t member = 0; member < batch.size; ++member) {
    int64_t entry[6];
    for (int k = 0; k < 6; ++k) entry[k] = batch.entry(given[k], member);
    const auto reals = [&](int k) { return data_of<Real>(given[k], entry[k]); };
    const Targets<Real> targets{reals(0), data_of<int32_t>(given[1], entry[1]), reals(2), reals(3),
                                given[0].length(0), given[1].length(0), given[2].length(0)};
    const Rays<Real> rays{reals(4), given[4].length(0) == 1 ? 0 : 3, reals(5), out.size()};
    walk(*kept_tree(targets), targets, rays, any, data_of<int32_t>(out, member));
  }
}

bool is_single(const XLA_FFI_CallFrame* frame) { return argument(frame, 0, 1).single(); }

}  // namespace

#define PINHOLE_CALL(name, body)                                                             \
  PINHOLE_HANDLER XLA_FFI_Error* name(XLA_FFI_CallFrame* frame) {                            \
    return guarded(frame, [&] {                                                              \
      is_single(frame) ? body<float>(frame) : body<double>(frame);                           \
    });                                                                                      \
  }

PINHOLE_CALL(pinhole_image, draw_images)
PINHOLE_CALL(pinhole_image_push, push_all)
PINHOLE_CALL(pinhole_image_pull, pull_all)
PINHOLE_CALL(pinhole_look, take_look)
PINHOLE_CALL(pinhole_walk, walk_all)

// Tables of a look, for Python: how many numbers there are, then these, once. Of the pixels that an
// outline touches: whether rows begin covered, then cells, coverage, whether the pixels that follow
// are covered, weights, residuals and derivatives (n, P). Or the `outline` that the look shows.
PINHOLE_HANDLER void* pinhole_table(void* const* arguments, int64_t model, int64_t outline, int64_t* number) {
  try {
    const Look look = look_of(arguments, model);
    auto table = std::make_unique<std::vector<double>>();
    if (outline) {
      const int32_t* size = array(arguments[9], 1).integers(0);
      *table = outline_of(look, size[0], size[1]);
    } else {
      const auto add = [&](const auto& some) { table->insert(table->end(), some.begin(), some.end()); };
      table->push_back(look.touched.before);
      add(look.touched.cell), add(look.touched.coverage), add(look.touched.after);
      add(look.weight), add(look.residual), add(look.rows);
    }
    *number = int64_t(table->size());
    return table.release();
  } catch (const std::exception&) {
    return nullptr;
  }
}
PINHOLE_HANDLER void pinhole_table_read(void* handle, double* numbers) {
  const auto* table = static_cast<std::vector<double>*>(handle);
  std::copy(table->begin(), table->end(), numbers);
  delete table;
}
