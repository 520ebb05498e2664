#pragma once

#include <type_traits>
#include <utility>
#include <vector>

#include "common/tensors.h"
#include "rollout/laws_p2g.h"

// Fields of the particles of a call, written and reordered between two buffers.
namespace mpm {

// A field of the particles, [P, ...]: the given tensor, or one of two buffers.
template <class E>
class OwnField {
 public:
  OwnField() = default;
  OwnField(const Tensor& x, const Field<const E>& given, Shape shape) : x_(x), shape_(std::move(shape)), now_(given) {}
  explicit OwnField(const Tensor& own) : x_(own), now_(field<const E>(own)), buffers_{own, absent()}, owned_(true) {
    for (int64_t i = 0; i < own.dim(); i++) shape_.push_back(own.size(i));
  }

  const Field<const E>& now() const { return now_; }
  const Tensor& tensor() const { return buffers_[turn_]; }

  // Destination of writes: the other buffer, or the current one.
  Field<E> next(bool elsewhere) {
    Tensor& to = buffers_[other(elsewhere)];
    if constexpr (std::is_same_v<E, int>) {
      if (!to.defined()) to = empty_int(x_, shape_);
    } else {
      if (!to.defined()) to = empty_particles(x_, shape_);
    }
    return field<E>(to);
  }
  // Reads and writes other tensors of the same shape.
  void use(const Tensor& now, const Tensor& next) {
    buffers_[0] = now;
    buffers_[1] = next;
    turn_ = 0;
    owned_ = true;
    now_ = field<const E>(now);
  }
  void go(bool elsewhere) {
    turn_ = other(elsewhere);
    owned_ = true;
    now_ = field<const E>(buffers_[turn_]);
  }

  // Adds its components to a list, with the destination `next(elsewhere)` if they are written.
  void rows(std::vector<ParticleRow<E>>& list, int first, bool written, bool elsewhere) {
    const Field<E> to = written ? next(elsewhere) : Field<E>{};
    const int64_t m = shape_.size() > 1 ? shape_[1] : 1, n = shape_.size() > 2 ? shape_[2] : 1;
    for (int64_t i = 0; i < m; i++)
      for (int64_t j = 0; j < n; j++)
        list.push_back({now_.pointer + i * now_.stride[1] + j * now_.stride[2], now_.stride[0],
                        written ? to.pointer + i * to.stride[1] + j * to.stride[2] : nullptr,
                        first < 0 ? -1 : first + int(i * n + j)});
  }

 private:
  int other(bool elsewhere) const { return owned_ ? (elsewhere ? 1 - turn_ : turn_) : 0; }

  Tensor x_ = absent();
  Shape shape_;
  Field<const E> now_;
  Tensor buffers_[2] = {absent(), absent()};
  int turn_ = 0;
  bool owned_ = false;
};

}  // namespace mpm
