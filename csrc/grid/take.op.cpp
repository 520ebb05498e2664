#include "grid/kernels.h"

// Fields of selected particles.
namespace mpm {

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
namespace cpu {
namespace {

void take(const TakeArguments& a, Stream) {
  constexpr int64_t grain = 4096;  // particles below which a range is not split
  parallel_ranges(a.count, grain, [&](int64_t begin, int64_t end) {
    for (int k = 0; k < a.columns; k++)
      for (int64_t i = begin; i < end; i++) {
        const int64_t particle = a.particle(i);
        a.column[k].write(i, a.has(particle) ? a.column[k].read(particle) : 0);
      }
  });
}

}  // namespace
}  // namespace cpu
#endif

namespace {

// Collects columns of fields, and launches the kernel when the arguments of a call are full.
class Taker {
 public:
  Taker(const Tensor& particles, int64_t rows, backend::Stream stream) : stream_(stream) {
    a_.particles = particles.data_ptr();
    a_.is_wide = particles.scalar_type() == ScalarType::Long;
    a_.rows = rows;
    a_.count = particles.size(0);
  }

  Tensor take(const Tensor& field) {
    Shape shape{a_.count};
    for (int64_t i = 1; i < field.dim(); i++) shape.push_back(field.size(i));
    Tensor result = empty_particles(field, shape);
    find(field, result, 1, static_cast<const char*>(field.data_ptr()), static_cast<char*>(result.data_ptr()));
    return result;
  }

  void finish() {
    if (a_.columns > 0) backend::take(a_, stream_);
    a_.columns = 0;
  }

 private:
  void find(const Tensor& field, const Tensor& result, int64_t axis, const char* from, char* to) {
    const int64_t size = int64_t(field.element_size());
    if (axis == field.dim()) {
      a_.column[a_.columns++] = {from, to, field.stride(0) * size, int(size)};
      if (a_.columns == kMostColumns) finish();
      return;
    }
    for (int64_t k = 0; k < field.size(axis); k++)
      find(field, result, axis + 1, from + k * field.stride(axis) * size, to + k * result.stride(axis) * size);
  }

  TakeArguments a_;
  backend::Stream stream_;
};

std::vector<Tensor> take(const std::vector<Tensor>& fields, const Tensor& particles) {
  check_rank(particles, "particles", 1);
  STD_TORCH_CHECK(particles.scalar_type() == ScalarType::Int || particles.scalar_type() == ScalarType::Long,
                  "particles must be int32 or int64, got ", name_of(particles.scalar_type()));
  STD_TORCH_CHECK(particles.is_contiguous(), "particles must be contiguous");
  check_count(particles.size(0), "particles", "numbers");
  for (const Tensor& field : fields) {
    STD_TORCH_CHECK(field.dim() > 0 && field.size(0) == fields[0].size(0),
                    "fields must be of one number of particles, got ", shape_of(fields[0]), " and ", shape_of(field));
    STD_TORCH_CHECK(field.device() == particles.device(), "fields must be on the device of particles");
    const int64_t size = int64_t(field.element_size());
    STD_TORCH_CHECK(size == 1 || size == 2 || size == 4 || size == 8,
                    "fields must have values of at most 8 bytes, got ", name_of(field.scalar_type()));
  }
  std::vector<Tensor> results;
  if (fields.empty()) return results;
  const DeviceScope device(particles);
  Taker taker(particles, fields[0].size(0), device.stream());
  for (const Tensor& field : fields) results.push_back(taker.take(field));
  taker.finish();
  return results;
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) { m.def("take(Tensor[] fields, Tensor particles) -> Tensor[]"); }
#endif

MPM_LIBRARY_IMPL(m) { m.impl("take", TORCH_BOX(&mpm::take)); }
