// Calls from XLA: arrays of a batch, attributes, errors. The C API's oldest form, which newer ones keep.
#pragma once

#include <cstring>
#include <string>
#include <vector>

#include "geometry.h"
#include "xla/c_api.h"

namespace pinhole {

// An array in a call; its last axes are its own, those before them the batch's.
struct Array {
  const XLA_FFI_Buffer* buffer;
  int64_t own;  // how many of its axes

  int64_t length(int64_t axis) const { return buffer->dims[buffer->rank - own + axis]; }
  int64_t size() const {
    int64_t n = 1;
    for (int64_t k = 0; k < own; ++k) n *= length(k);
    return n;
  }
  bool single() const { return buffer->dtype == XLA_FFI_DataType_F32; }
  Numbers numbers(int64_t member) const {
    return Numbers{buffer->data, single(), 0}.from(size() * member, size());
  }
  const int32_t* integers(int64_t member) const {
    return static_cast<const int32_t*>(buffer->data) + size() * member;
  }
};

// The leading axes of a call's results; arguments have them too, or 1 where all members share one.
struct Batch {
  std::vector<int64_t> shape;
  int64_t size = 1;

  Batch() = default;
  explicit Batch(const Array& result)
      : shape(result.buffer->dims, result.buffer->dims + result.buffer->rank - result.own) {
    for (int64_t n : shape) size *= n;
  }
  // Which entry of an array belongs to a member of the batch.
  int64_t entry(const Array& a, int64_t member) const {
    int64_t index = 0, stride = 1, axis = a.buffer->rank - a.own;
    for (size_t k = shape.size(); k-- > 0 && axis-- > 0;) {
      const int64_t n = a.buffer->dims[axis];
      index += n == 1 ? 0 : member % shape[k] * stride;
      stride *= n;
      member /= shape[k];
    }
    return index;
  }
};

inline Array array(const void* buffer, int64_t own) {
  return {static_cast<const XLA_FFI_Buffer*>(buffer), own};
}
inline Array argument(const XLA_FFI_CallFrame* frame, int64_t k, int64_t own) {
  return array(frame->args.args[k], own);
}
inline Array result(const XLA_FFI_CallFrame* frame, int64_t k, int64_t own) {
  return array(frame->rets.rets[k], own);
}

// An attribute that is a 64-bit integer; 0 if there is none.
inline int64_t attribute(const XLA_FFI_CallFrame* frame, const char* name) {
  for (int64_t k = 0; k < frame->attrs.size; ++k) {
    const XLA_FFI_ByteSpan& own = *frame->attrs.names[k];
    if (own.len != std::strlen(name) || std::memcmp(own.ptr, name, own.len) != 0) continue;
    return *static_cast<const int64_t*>(static_cast<const XLA_FFI_Scalar*>(frame->attrs.attrs[k])->value);
  }
  return 0;
}

inline XLA_FFI_Error* failure(const XLA_FFI_CallFrame* frame, const std::string& why) {
  XLA_FFI_Error_Create_Args args{};
  args.struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE;
  args.message = why.c_str();
  args.errc = XLA_FFI_Error_Code_INTERNAL;
  return frame->api->XLA_FFI_Error_Create(&args);
}

// Answers XLA's question for the version that a handler was built with; false if it asks none.
inline bool answered_version(const XLA_FFI_CallFrame* frame) {
  if (!frame->extension_start || frame->extension_start->type != XLA_FFI_Extension_Metadata) return false;
  XLA_FFI_Metadata* metadata = reinterpret_cast<XLA_FFI_Metadata_Extension*>(frame->extension_start)->metadata;
  metadata->api_version = {};
  metadata->api_version.struct_size = XLA_FFI_Api_Version_STRUCT_SIZE;
  metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  metadata->api_version.minor_version = XLA_FFI_API_MINOR;
  metadata->traits = 0;
  return true;
}

// Runs a handler's body: no exception crosses the boundary.
template <class Body>
XLA_FFI_Error* guarded(XLA_FFI_CallFrame* frame, Body body) {
  if (answered_version(frame)) return nullptr;
  try {
    body();
    return nullptr;
  } catch (const std::exception& error) {
    return failure(frame, error.what());
  }
}

}  // namespace pinhole
