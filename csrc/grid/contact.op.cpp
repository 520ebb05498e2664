#include <algorithm>
#include <cmath>
#include <limits>

#include "grid/kernels.h"
#include "grid/topology.op.h"

// Contact of the grid with rigid obstacles.
namespace mpm {
namespace {

#define MPM_CONTACT_SCHEMA                                                                                      \
  "Tensor velocity, Tensor obstacles, Tensor outline, int[] shape, int[] corners, int[] contact, int[] scene, " \
  "float[] start, float[] end, Tensor? scene_time, float time, " MPM_TOPOLOGY_SCHEMA
#define MPM_CONTACT_PARAMETERS                                                                           \
  const Tensor &velocity, const Tensor &obstacles, const Tensor &outline, std::vector<int64_t> shape,    \
      std::vector<int64_t> corners, std::vector<int64_t> contact_kind, std::vector<int64_t> scene,       \
      std::vector<double> start, std::vector<double> end, const OptionalTensor &scene_time, double time, \
      const std::vector<Tensor>&topology, const std::vector<double>&lattice, const std::vector<int64_t>&layout
#define MPM_CONTACT_ARGUMENTS                                                                                         \
  velocity, obstacles, outline, shape, corners, contact_kind, scene, start, end, scene_time, time, topology, lattice, \
      layout

void check_velocity(const Tensor& velocity) {
  STD_TORCH_CHECK(velocity.dim() == 2 && (velocity.size(1) == 2 || velocity.size(1) == 3),
                  "velocity must have shape [N, 2] or [N, 3], got ", shape_of(velocity));
  check_count(velocity.size(0), "velocity", "nodes");
}

template <class T, int D>
ContactArguments<T, D> contact_arguments(MPM_CONTACT_PARAMETERS) {
  const PackedTopology blocks(topology, lattice, layout);
  ContactArguments<T, D> a;
  a.geometry = blocks.geometry<T, D>();
  a.dx = blocks.dx();
  T largest = T(0);  // coordinate of a node
  for (int i = 0; i < D; i++) {
    a.lower[i] = blocks.lower()[i];
    const double upper = a.lower[i] + a.dx * double(a.geometry.blocks[i] * kBlockWidth);
    largest = std::fmax(largest, T(std::fmax(std::fabs(a.lower[i]), std::fabs(upper))));
  }
  a.rounding = 16 * std::numeric_limits<T>::epsilon() * largest;
  a.max_blocks = blocks.max_blocks<D>();
  a.block = blocks.block_pointer(velocity);
  const auto v = node_input<T>(velocity, "velocity", velocity, blocks.node_count<D>());
  a.velocity = v.pointer;
  a.stride = v.stride;
  constexpr int64_t width = ObstacleRow<T, D>::width;
  static_assert(sizeof(ObstacleRow<T, D>) == width * sizeof(T));
  check_rank(obstacles, "obstacles", 3);
  check_like(obstacles, "obstacles", velocity);
  STD_TORCH_CHECK(obstacles.is_contiguous() && obstacles.size(0) > 0 && obstacles.size(0) <= INT32_MAX &&
                      obstacles.size(1) <= kMaxObstacles && obstacles.size(2) == width,
                  "obstacles must be contiguous with shape [1 or B, at most ", kMaxObstacles, ", ", width, "], got ",
                  shape_of(obstacles));
  a.row = static_cast<const ObstacleRow<T, D>*>(obstacles.data_ptr());
  a.rows = int(obstacles.size(0));
  a.obstacles = int(obstacles.size(1));
  const size_t count = size_t(a.obstacles);
  const auto check_entries = [&](const auto& list, const char* name) {
    STD_TORCH_CHECK(list.size() == count, name, " must have an entry per obstacle, ", count, ", got ", list.size());
  };
  check_entries(shape, "shape");
  check_entries(corners, "corners");
  check_entries(contact_kind, "contact");
  check_entries(scene, "scene");
  check_entries(start, "start");
  check_entries(end, "end");
  int64_t corner = 0;
  for (size_t k = 0; k < count; k++) {
    STD_TORCH_CHECK(shape[k] >= int64_t(ObstacleShape::plane) && shape[k] <= int64_t(ObstacleShape::revolved),
                    "shape must be 0 to 4, got ", shape[k]);
    STD_TORCH_CHECK(corners[k] >= 0 && corners[k] <= INT32_MAX / kMaxObstacles,
                    "corners must not be negative nor too many, got ", corners[k]);
    STD_TORCH_CHECK(contact_kind[k] >= int64_t(Contact::sticky) && contact_kind[k] <= int64_t(Contact::separate),
                    "contact must be 1 to 3, got ", contact_kind[k]);
    STD_TORCH_CHECK(scene[k] >= -1 && scene[k] <= INT32_MAX, "scene must be -1 or a scene, got ", scene[k]);
    a.kind[k] = {ObstacleShape(shape[k]), Contact(contact_kind[k]), int(scene[k]), start[k], end[k], int(corner),
                 int(corners[k])};
    corner += corners[k];
  }
  check_shape(outline, "outline", {corner, 2});
  check_like(outline, "outline", velocity);
  STD_TORCH_CHECK(outline.is_contiguous(), "outline must be contiguous, got shape ", shape_of(outline));
  a.outline = static_cast<const T*>(outline.data_ptr());
  a.time = time;
  if (has(scene_time)) {
    check_rank(*scene_time, "scene_time", 1);
    check_like(*scene_time, "scene_time", velocity);
    STD_TORCH_CHECK(scene_time->is_contiguous() && scene_time->size(0) > 0 && scene_time->size(0) <= INT32_MAX,
                    "scene_time must be contiguous with shape [1 or B], got ", shape_of(*scene_time));
    a.scene_time = static_cast<const T*>(scene_time->data_ptr());
    a.times = int(scene_time->size(0));
  }
  return a;
}

Tensor contact(MPM_CONTACT_PARAMETERS) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor rows = empty(velocity, {velocity.size(0), 1 + velocity.size(1)});
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    auto a = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
    a.result = static_cast<T*>(rows.data_ptr());
    backend::contact(a, device.stream());
  });
  return rows;
}

// `rows` is the adjoint of the obstacles by each slot, empty unless it is wanted.
std::tuple<Tensor, Tensor> contact_backward(const Tensor& grad, bool wants_rows, MPM_CONTACT_PARAMETERS) {
  const DeviceScope device(velocity);
  check_velocity(velocity);
  Tensor grad_velocity = empty(velocity, {velocity.size(0), 1 + velocity.size(1)}), rows;
  dispatch(velocity, "velocity", velocity.size(1), [&]<class T, int D>() {
    auto a = contact_arguments<T, D>(MPM_CONTACT_ARGUMENTS);
    check_shape(grad, "grad", {velocity.size(0), D});
    const auto g = node_input<T>(grad, "grad", velocity, velocity.size(0));
    a.grad = g.pointer;
    a.grad_stride = g.stride;
    a.result = static_cast<T*>(grad_velocity.data_ptr());
    rows = empty(velocity, {wants_rows ? a.max_blocks : 0, a.obstacles, ObstacleRow<T, D>::width});
    if (wants_rows) a.row_grad = static_cast<T*>(rows.data_ptr());
    backend::contact_backward(a, device.stream());
  });
  return {grad_velocity, rows};
}

}  // namespace
}  // namespace mpm

#if MPM_BACKEND == MPM_BACKEND_IS_cpu
STABLE_TORCH_LIBRARY_FRAGMENT(torch_mpm, m) {
  m.def("contact(" MPM_CONTACT_SCHEMA ") -> Tensor");
  m.def("contact_backward(Tensor grad, bool wants_rows, " MPM_CONTACT_SCHEMA ") -> (Tensor velocity, Tensor rows)");
}
#endif

MPM_LIBRARY_IMPL(m) {
  m.impl("contact", TORCH_BOX(&mpm::contact));
  m.impl("contact_backward", TORCH_BOX(&mpm::contact_backward));
}
