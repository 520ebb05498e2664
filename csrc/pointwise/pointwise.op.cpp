#include <sstream>

#include "common/backend.h"
#include "pointwise/functions.h"

#define MPM_POINTWISE_KERNELS(PLAIN, ORDERED, SIZE)     \
  PLAIN(pointwise, PointwiseArguments)                  \
  PLAIN(pointwise_backward, PointwiseBackwardArguments) \
  PLAIN(pointwise_second, PointwiseSecondArguments)
MPM_BACKEND_KERNELS(MPM_POINTWISE_KERNELS)

// Functions of a row: each argument is a tensor, with a row for each particle or node or one for all, or a number.
namespace mpm {
namespace {

using Tensors = std::vector<Tensor>;
using Places = std::vector<int64_t>;

struct FunctionInfo {
  int number = -1;
  const char* name = nullptr;
  std::vector<Entries> arguments, results;
};

template <class Function>
FunctionInfo info_of(int number) {
  return {number,
          Function::name,
          {std::begin(Function::arguments), std::end(Function::arguments)},
          {std::begin(Function::results), std::end(Function::results)}};
}

const std::vector<FunctionInfo>& functions() {
  static const std::vector<FunctionInfo> all = [] {
    std::vector<FunctionInfo> list;
    for (int k = 0; k < int(std::tuple_size_v<PointwiseFunctions>); k++)
      with_function(k, [&]<class Function>() { list.push_back(info_of<Function>(k)); });
    return list;
  }();
  return all;
}

const FunctionInfo& function_of(const std::string& name) {
  std::string names;
  for (const FunctionInfo& f : functions()) {
    if (name == f.name) return f;
    names += (names.empty() ? "" : ", ") + std::string(f.name);
  }
  STD_TORCH_CHECK(false, "function must be one of ", names, ", got ", name);
}

int rank_of(const Entries& e) { return e.rows == 0 ? 0 : e.columns == 0 ? 1 : 2; }
bool is_matrix(const Entries& e) { return e.rows == kDimension && e.columns == kDimension; }
int size_of(const Entries& e, int dim) { return extent(e.rows, dim) * extent(e.columns, dim); }

// Each place names an argument or result; places are distinct.
void check_places(const char* name, const Places& places, size_t count) {
  std::vector<bool> taken(count, false);
  for (int64_t place : places) {
    STD_TORCH_CHECK(place >= 0 && place < int64_t(count) && !taken[size_t(place)], name,
                    " must be different numbers below ", count, ", got ", text(places));
    taken[size_t(place)] = true;
  }
}

// First entry of each argument or result.
std::vector<int> offsets(const std::vector<Entries>& list, int dim) {
  std::vector<int> first(list.size() + 1, 0);
  for (size_t k = 0; k < list.size(); k++) first[k + 1] = first[k] + size_of(list[k], dim);
  return first;
}

Shape shape_of_rows(const Entries& e, int64_t rows, int dim) {
  Shape shape{rows};
  if (rank_of(e) > 0) shape.push_back(extent(e.rows, dim));
  if (rank_of(e) > 1) shape.push_back(extent(e.columns, dim));
  return shape;
}

// Whether a tensor is shared by all rows: one without the dimension of rows, and a scalar [1].
bool is_shared(const Tensor& t, const Entries& e, int64_t rows) {
  return t.dim() == rank_of(e) || (rank_of(e) == 0 && t.dim() == 1 && t.size(0) == 1 && rows != 1);
}

// Sets the columns of a tensor whose shape has been checked.
template <class T>
void set_columns(Column<T>* columns, const Tensor& t, const Entries& e, int64_t rows, int dim) {
  const bool shared = is_shared(t, e, rows);
  const int64_t first = t.dim() - rank_of(e), inner = rank_of(e) > 1 ? extent(e.columns, dim) : 1;
  for (int64_t n = 0; n < size_of(e, dim); n++) {
    int64_t shift = rank_of(e) > 0 ? n / inner * t.stride(first) : 0;
    if (rank_of(e) > 1) shift += n % inner * t.stride(first + 1);
    columns[n] = {static_cast<T*>(t.data_ptr()) + shift, shared ? 0 : t.stride(0)};
  }
}

// A call in the form of ops, checked.
struct Call {
  const FunctionInfo& function;
  const int dim;
  const Tensors& tensors;
  const Places& places;
  const std::vector<double>& numbers;
  int64_t rows = 0;
  Tensor like;

  Call(const std::string& name, int64_t dim_, const Tensors& tensors_, const Places& places_,
       const std::vector<double>& numbers_)
      : function(function_of(name)), dim(int(dim_)), tensors(tensors_), places(places_), numbers(numbers_) {
    STD_TORCH_CHECK(dim == 2 || dim == 3, "dim must be 2 or 3, got ", dim);
    STD_TORCH_CHECK(!tensors.empty() && tensors.size() == places.size(), "places must have an entry for each of the ",
                    tensors.size(), " tensors, at least one, got ", places.size());
    STD_TORCH_CHECK(numbers.size() == function.arguments.size(), "numbers must have ", function.arguments.size(),
                    " entries for the function ", function.name, ", got ", numbers.size());
    check_places("places", places, function.arguments.size());
    count_rows();
    for (size_t i = 0; i < tensors.size(); i++) check(tensors[i], "tensors", i, function.arguments, places[i], true);
  }

  // Rows of the arguments: a scalar of one row may be shared by all rows.
  void count_rows() {
    bool none = false;
    for (size_t i = 0; i < tensors.size(); i++) {
      const Tensor& t = tensors[i];
      if (t.dim() != rank_of(function.arguments[size_t(places[i])]) + 1) continue;
      none = none || t.size(0) == 0;
      if (!like.defined() || t.size(0) > like.size(0)) like = t;
    }
    STD_TORCH_CHECK(like.defined(), "one of tensors must have a row for each particle");
    rows = none ? 0 : like.size(0);
    check_count(rows, "tensors", "rows");
  }

  void check(const Tensor& t, const char* list, size_t i, const std::vector<Entries>& kinds, int64_t place,
             bool may_be_shared) const {
    const std::string name = std::string(list) + "[" + std::to_string(i) + "]";
    check_like(t, name.c_str(), like);
    const Entries& e = kinds[size_t(place)];
    Shape shape = shape_of_rows(e, rows, dim);
    if (may_be_shared && is_shared(t, e, rows)) {
      if (rank_of(e) == 0) return;
      shape.erase(shape.begin());
    }
    check_shape(t, name.c_str(), shape);
  }

  template <class T, int D>
  void set(PointwiseArguments<T, D>& a) const {
    a.count = rows;
    a.function = function.number;
    const std::vector<int> first = offsets(function.arguments, D);
    for (size_t k = 0; k < numbers.size(); k++)  // for a matrix that multiple of the identity
      for (int n = first[k]; n < first[k + 1]; n++) {
        const bool zero = is_matrix(function.arguments[k]) && (n - first[k]) % (D + 1) != 0;
        a.number[n] = zero ? T(0) : T(numbers[k]);
      }
    set_all(a.argument, tensors, places, function.arguments);
  }

  template <class T>
  void set_all(Column<T>* columns, const Tensors& given, const Places& at, const std::vector<Entries>& kinds) const {
    const std::vector<int> first = offsets(kinds, dim);
    for (size_t i = 0; i < given.size(); i++)
      set_columns(columns + first[size_t(at[i])], given[i], kinds[size_t(at[i])], rows, dim);
  }

  // A tensor of rows for each place.
  Tensors allocate(const std::vector<Entries>& kinds, const Places& at) const {
    Tensors made;
    for (int64_t place : at) made.push_back(empty_particles(like, shape_of_rows(kinds[size_t(place)], rows, dim)));
    return made;
  }

  // Places of the arguments of some of the tensors.
  Places places_of(const Places& wanted) const {
    check_places("wanted", wanted, places.size());
    Places at;
    for (int64_t i : wanted) at.push_back(places[size_t(i)]);
    return at;
  }

  void check_rows(const char* list, const Tensors& given, const Places& at, const std::vector<Entries>& kinds) const {
    STD_TORCH_CHECK(given.size() == at.size(), list, " must have a place for each of ", given.size(), " tensors, got ",
                    at.size());
    check_places(list, at, kinds.size());
    for (size_t i = 0; i < given.size(); i++) check(given[i], list, i, kinds, at[i], false);
  }
};

Tensors pointwise(std::string name, int64_t dim, Tensors tensors, Places places, std::vector<double> numbers,
                  Places wanted) {
  const Call call(name, dim, tensors, places, numbers);
  check_places("wanted", wanted, call.function.results.size());
  Tensors results = call.allocate(call.function.results, wanted);
  const DeviceScope device(call.like);
  dispatch(call.like, "tensors", dim, [&]<class T, int D>() {
    PointwiseArguments<T, D> a;
    call.set(a);
    call.set_all(a.result, results, wanted, call.function.results);
    backend::pointwise(a, device.stream());
  });
  return results;
}

Tensors pointwise_backward(std::string name, int64_t dim, Tensors tensors, Places places, std::vector<double> numbers,
                           Tensors adjoints, Places adjoint_places, Places wanted) {
  const Call call(name, dim, tensors, places, numbers);
  call.check_rows("adjoints", adjoints, adjoint_places, call.function.results);
  const Places at = call.places_of(wanted);
  Tensors gradients = call.allocate(call.function.arguments, at);
  const DeviceScope device(call.like);
  dispatch(call.like, "tensors", dim, [&]<class T, int D>() {
    PointwiseBackwardArguments<T, D> a;
    call.set(a);
    call.set_all(a.adjoint, adjoints, adjoint_places, call.function.results);
    call.set_all(a.gradient, gradients, at, call.function.arguments);
    backend::pointwise_backward(a, device.stream());
  });
  return gradients;
}

Tensors pointwise_second(std::string name, int64_t dim, Tensors tensors, Places places, std::vector<double> numbers,
                         Tensors adjoints, Places adjoint_places, Tensors tangents, Places tangent_places,
                         Places wanted) {
  const Call call(name, dim, tensors, places, numbers);
  call.check_rows("adjoints", adjoints, adjoint_places, call.function.results);
  call.check_rows("tangents", tangents, tangent_places, call.function.arguments);
  const Places at = call.places_of(wanted);
  Tensors gradients = call.allocate(call.function.arguments, at);
  Tensors of_adjoints = call.allocate(call.function.results, adjoint_places);
  const DeviceScope device(call.like);
  dispatch(call.like, "tensors", dim, [&]<class T, int D>() {
    PointwiseSecondArguments<T, D> a;
    call.set(a);
    call.set_all(a.adjoint, adjoints, adjoint_places, call.function.results);
    call.set_all(a.tangent, tangents, tangent_places, call.function.arguments);
    call.set_all(a.gradient, gradients, at, call.function.arguments);
    call.set_all(a.adjoint_gradient, of_adjoints, adjoint_places, call.function.results);
    backend::pointwise_second(a, device.stream());
  });
  gradients.insert(gradients.end(), of_adjoints.begin(), of_adjoints.end());
  return gradients;
}

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
std::string entries_as_json(const std::vector<Entries>& list) {
  std::ostringstream text;
  for (const Entries& e : list) text << (&e == &list[0] ? "[" : ", ") << "[" << e.rows << ", " << e.columns << "]";
  return text.str() + "]";
}

std::string functions_as_json() {
  std::string text;
  for (const FunctionInfo& f : functions())
    text += (text.empty() ? "[" : ", ") + std::string("{\"name\": \"") + f.name +
            "\", \"arguments\": " + entries_as_json(f.arguments) + ", \"results\": " + entries_as_json(f.results) + "}";
  return text + "]";
}
#endif

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
extern "C" __attribute__((visibility("default"))) const char* torch_mpm_functions() {
  static const std::string text = mpm::functions_as_json();
  return text.c_str();
}

#define MPM_POINTWISE_SCHEMA "str function, int dim, Tensor[] tensors, int[] places, float[] numbers, "
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("pointwise(" MPM_POINTWISE_SCHEMA "int[] wanted) -> Tensor[]");
  m.def("pointwise_backward(" MPM_POINTWISE_SCHEMA
        "Tensor[] adjoints, int[] adjoint_places, int[] wanted) -> Tensor[]");
  m.def("pointwise_second(" MPM_POINTWISE_SCHEMA
        "Tensor[] adjoints, int[] adjoint_places, Tensor[] tangents, int[] tangent_places, int[] wanted) -> Tensor[]");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("pointwise", TORCH_BOX(&mpm::pointwise));
  m.impl("pointwise_backward", TORCH_BOX(&mpm::pointwise_backward));
  m.impl("pointwise_second", TORCH_BOX(&mpm::pointwise_second));
}
