#pragma once

#include "common/dual.h"
#include "common/lanes.h"

// Functions of a particle (or node): a few input entries and a few output entries, independent of its neighbours. Each
// is written once, for any scalar: its derivatives are those of dual numbers, one evaluation for each requested input
// entry.
namespace mpm {

// Shape of an argument or result in a row of its tensor: empty for a scalar, or numbers, where kDimension means D.
struct Entries {
  int rows = 0, columns = 0;
};
constexpr int kDimension = -1;
constexpr Entries kScalar{}, kVector{kDimension}, kMatrix{kDimension, kDimension};

constexpr int extent(int entries, int dim) { return entries == kDimension ? dim : entries == 0 ? 1 : entries; }

template <int N>
constexpr int entries_of(const Entries (&list)[N], int dim) {
  int sum = 0;
  for (const Entries& e : list) sum += extent(e.rows, dim) * extent(e.columns, dim);
  return sum;
}

constexpr int kMostArguments = 32, kMostResults = 16;  // entries, in 3-D

// One entry of all rows; a null pointer is absent.
template <class T>
struct Column {
  T* pointer = nullptr;
  int64_t stride = 0;  // zero: the same for all
};

template <class T, int D>
struct PointwiseArguments {
  int64_t count = 0;
  int function = 0;
  Column<const T> argument[kMostArguments];
  T number[kMostArguments] = {};   // where there is no column
  Column<T> result[kMostResults];  // absent where not requested
};

// Adjoints ḡ of the results give those of the arguments, ḡ · ∂f.
template <class T, int D>
struct PointwiseBackwardArguments : PointwiseArguments<T, D> {
  Column<const T> adjoint[kMostResults];
  Column<T> gradient[kMostArguments];  // absent where not requested
};

// Derivatives of ḡ · ∂f v by the arguments and by ḡ.
template <class T, int D>
struct PointwiseSecondArguments : PointwiseBackwardArguments<T, D> {
  Column<const T> tangent[kMostArguments];  // v
  Column<T> adjoint_gradient[kMostResults];
};

inline namespace TORCH_MPM_ISA {

// Arguments of a function one after another, and its results.
template <class T, int D>
struct Reader {
  const T* next;
  MPM_HD T scalar() { return *next++; }
  MPM_HD Vector<T, D> vector() {
    Vector<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++)
      r[i] = *next++;
    return r;
  }
  MPM_HD Matrix<T, D> matrix() {
    Matrix<T, D> r;
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) r[i][j] = *next++;
    return r;
  }
};

template <class T, int D>
struct Writer {
  T* next;
  MPM_HD void put(const T& value) { *next++ = value; }
  MPM_HD void put(const Vector<T, D>& value) {
    MPM_UNROLL for (int i = 0; i < D; i++)
      put(value[i]);
  }
  MPM_HD void put(const Matrix<T, D>& value) {
    MPM_UNROLL for (int i = 0; i < D; i++) MPM_UNROLL
      for (int j = 0; j < D; j++) put(value[i][j]);
  }
};

template <class Function, int D>
struct Applied {
  static constexpr int kIn = entries_of(Function::arguments, D), kOut = entries_of(Function::results, D);
  static_assert(kIn <= kMostArguments && kOut <= kMostResults);

  template <class V>
  MPM_HD static void evaluate(const V (&in)[kIn], V (&out)[kOut]) {
    Reader<V, D> reader{in};
    Writer<V, D> writer{out};
    Function::evaluate(reader, writer);
  }

  template <class At, class T, class V>
  MPM_HD static void load(const At& at, const PointwiseArguments<T, D>& a, V (&in)[kIn]) {
    MPM_UNROLL for (int n = 0; n < kIn; n++)
      in[n] = a.argument[n].pointer ? at.load_shared(a.argument[n].pointer, a.argument[n].stride) : V(a.number[n]);
  }

  template <int N, class At, class T, class V>
  MPM_HD static void load_or_zero(const At& at, const Column<const T>* columns, V (&values)[N]) {
    MPM_UNROLL for (int n = 0; n < N; n++)
      values[n] = columns[n].pointer ? at.load_shared(columns[n].pointer, columns[n].stride) : V(T(0));
  }

  template <class At, class T>
  MPM_HD static void forward_at(const PointwiseArguments<T, D>& a, const At& at) {
    typename At::Value in[kIn], out[kOut];
    load(at, a, in);
    evaluate(in, out);
    MPM_UNROLL for (int n = 0; n < kOut; n++)
      if (a.result[n].pointer) at.store(a.result[n].pointer, a.result[n].stride, out[n]);
  }

  // Calls put(n, ḡ · ∂f/∂n) for the input entries n that are wanted, with the adjoints ḡ of the output entries.
  template <class V, class Wanted, class Put>
  MPM_HD static void pull_back(const V (&in)[kIn], const V (&adjoint)[kOut], const Wanted& wanted, const Put& put) {
    Dual<V> x[kIn], y[kOut];
    MPM_UNROLL for (int n = 0; n < kIn; n++)
      x[n] = {in[n], V(0)};
    for (int n = 0; n < kIn; n++) {
      if (!wanted(n)) continue;
      x[n].derivative = V(1);
      evaluate(x, y);
      x[n].derivative = V(0);
      V sum = adjoint[0] * y[0].derivative;
      MPM_UNROLL for (int k = 1; k < kOut; k++)
        sum = sum + adjoint[k] * y[k].derivative;
      put(n, sum);
    }
  }

  template <class At, class T>
  MPM_HD static void backward_at(const PointwiseBackwardArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    V in[kIn], adjoint[kOut];
    load(at, a, in);
    load_or_zero(at, a.adjoint, adjoint);
    pull_back(
        in, adjoint, [&](int n) { return a.gradient[n].pointer != nullptr; },
        [&](int n, const V& sum) { at.store(a.gradient[n].pointer, a.gradient[n].stride, sum); });
  }

  template <class At, class T>
  MPM_HD static void second_at(const PointwiseSecondArguments<T, D>& a, const At& at) {
    using V = typename At::Value;
    V in[kIn], tangent[kIn], adjoint[kOut];
    load(at, a, in);
    load_or_zero(at, a.tangent, tangent);
    load_or_zero(at, a.adjoint, adjoint);
    const V zero = V(T(0));
    Dual<Dual<V>> x[kIn], y[kOut];  // the outer derivative is that along the tangents
    MPM_UNROLL for (int n = 0; n < kIn; n++)
      x[n] = {{in[n], zero}, {tangent[n], zero}};
    evaluate(x, y);
    MPM_UNROLL for (int k = 0; k < kOut; k++)
      if (a.adjoint_gradient[k].pointer)
        at.store(a.adjoint_gradient[k].pointer, a.adjoint_gradient[k].stride, y[k].derivative.value);
    for (int n = 0; n < kIn; n++) {
      if (!a.gradient[n].pointer) continue;
      x[n].value.derivative = V(T(1));
      evaluate(x, y);
      x[n].value.derivative = zero;
      V sum = adjoint[0] * y[0].derivative.derivative;
      MPM_UNROLL for (int k = 1; k < kOut; k++)
        sum = sum + adjoint[k] * y[k].derivative.derivative;
      at.store(a.gradient[n].pointer, a.gradient[n].stride, sum);
    }
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
