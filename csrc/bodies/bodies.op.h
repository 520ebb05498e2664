#pragma once

#include "bodies/kernels.h"
#include "grid/obstacle.op.h"

// Free bodies as the ops take them, packed by torch_mpm/ops/free_bodies.py and unpacked here.
namespace mpm {

// bodies: rows [B, K, 6 or 13], obstacles [1 or B, O, width], data of their shapes [n], constants [K, width], poses of
// the obstacles in their bodies [O, width], gravity [1 or B, D], and wrenches [B, K, 3 or 6] where there are some.
#define MPM_BODIES_SCHEMA                                                                                         \
  "Tensor[] bodies, int[] body_shape, int[] body_sizes, int[] body_contact, int[] body_owner, int[] body_joint, " \
  "int max_iterations, float tolerance"
#define MPM_BODIES_PARAMETERS                                                                                     \
  const std::vector<Tensor>&bodies, const std::vector<int64_t>&body_shape, const std::vector<int64_t>&body_sizes, \
      const std::vector<int64_t>&body_contact, const std::vector<int64_t>&body_owner,                             \
      const std::vector<int64_t>&body_joint, int64_t max_iterations, double tolerance
#define MPM_BODIES_ARGUMENTS \
  bodies, body_shape, body_sizes, body_contact, body_owner, body_joint, max_iterations, tolerance

struct BodiesInputs {
  std::vector<Tensor> bodies;
  std::vector<int64_t> shape, sizes, contact, owner, joint;
  int64_t max_iterations;
  double tolerance;
};

// Arguments of a call of many steps, and the rows and the report that its steps write, see BodiesCall.
struct BodiesOfCall {
  BodiesInputs in;
  Tensor rows = absent(), report = absent();
};

// The bodies of a call of one or many steps, with the tensors that belong to it.
template <class T, int D>
class BodiesCall {
 public:
  // `like` has the dtype and device of the nodes.
  BodiesCall(const BodiesInputs& in, const Tensor& like, const PackedLattice& lattice, MPM_CONTACT_WALLS_PARAMETERS,
             int64_t scenes, double dt);

  // Scenes with time steps of their own: factors of dt.
  void set_scene_dt(const T* factors) { a_.scene_dt = factors; }

  // Lets steps store their solution, see FreeBodiesArguments.
  void set_solution(const Tensor& motion, const Tensor& slopes) {
    a_.motion = static_cast<double*>(motion.data_ptr());
    a_.slopes = static_cast<double*>(slopes.data_ptr());
  }

  // Rows at the end of the steps so far, float64; the most iterations and the largest residuals [B, 1 + K].
  const Tensor& rows() const { return rows_; }
  const Tensor& report() const { return report_; }

  // A step of the bodies, which changes the velocities of the nodes in place. On CUDA the first slots have the blocks
  // with particles, and further ones those of a margin.
  void run(const int* block, int first_slots, int max_blocks, const T* mass, int64_t mass_stride, T* velocity,
           int64_t stride, backend::Stream stream) {
    a_.contact.block = block;
    a_.contact.max_blocks = max_blocks;
    a_.first_slots = first_slots;
    a_.contact.mass = mass;
    a_.contact.mass_stride = mass_stride;
    a_.velocity = velocity;
    a_.stride = stride;
    const int64_t bytes = backend::free_bodies_workspace(a_, stream);
    if (bytes > 0 && (!workspace_.defined() || workspace_.size(0) < bytes))
      workspace_ = empty(report_, {bytes}, ScalarType::Byte);
    a_.workspace = workspace_.defined() ? static_cast<char*>(workspace_.data_ptr()) : nullptr;
    backend::free_bodies(a_, stream);
  }

 private:
  void set_obstacles(const BodiesInputs& in, const Tensor& like, const PackedLattice& lattice, int64_t scenes);
  void set_bodies(const BodiesInputs& in, const Tensor& like, int64_t scenes);

  FreeBodiesArguments<T, D> a_;
  std::vector<Tensor> given_;  // as long as the call lasts
  Tensor rows_, report_, workspace_ = absent();
};

// Contiguous numbers of a shape.
inline const double* doubles(const Tensor& t, const char* name, const Tensor& like, const Shape& shape) {
  check_shape(t, name, shape);
  check_type(t, name, ScalarType::Double, like);
  STD_TORCH_CHECK(t.is_contiguous(), name, " must be contiguous, got shape ", shape_of(t));
  return static_cast<const double*>(t.data_ptr());
}

template <class T, int D>
BodiesCall<T, D>::BodiesCall(const BodiesInputs& in, const Tensor& like, const PackedLattice& lattice,
                             MPM_CONTACT_WALLS_PARAMETERS, int64_t scenes, double dt)
    : given_(in.bodies) {
  STD_TORCH_CHECK(given_.size() == 6 || given_.size() == 7,
                  "bodies must be rows, obstacles, data, constants, parts, gravity and perhaps wrenches, got ",
                  given_.size(), " tensors");
  STD_TORCH_CHECK(dt > 0 && std::isfinite(dt), "dt must be positive and finite, got ", dt);
  STD_TORCH_CHECK(in.tolerance > 0 && std::isfinite(in.tolerance), "tolerance must be positive and finite, got ",
                  in.tolerance);
  STD_TORCH_CHECK(in.max_iterations >= 0 && in.max_iterations <= 1000, "max_iterations must be 0 to 1000, got ",
                  in.max_iterations);
  STD_TORCH_CHECK(scenes > 0 && scenes <= INT32_MAX, "there must be 1 to 2^31 - 1 scenes, got ", scenes);
  set_obstacles(in, like, lattice, scenes);
  set_walls(a_.contact, wall_kind, wall_plane);
  set_bodies(in, like, scenes);
  a_.dt = dt;
  a_.tolerance = in.tolerance;
  a_.max_iterations = int(in.max_iterations);
}

template <class T, int D>
void BodiesCall<T, D>::set_obstacles(const BodiesInputs& in, const Tensor& like, const PackedLattice& lattice,
                                     int64_t scenes) {
  const size_t count = in.shape.size();
  const Tensor& table = given_[1];
  check_rank(table, "obstacles of bodies", 3);
  const int64_t table_rows = table.size(0) == 1 ? 1 : scenes;
  check_shape(table, "obstacles of bodies", {table_rows, int64_t(count), ObstacleRow<T, D>::width});
  check_like(table, "obstacles of bodies", like);
  check_rank(given_[2], "data of bodies", 1);
  check_like(given_[2], "data of bodies", like);
  constexpr double always = std::numeric_limits<double>::infinity();
  a_.contact = obstacle_arguments<T, D>(like, lattice, given_[1], given_[2], in.shape, in.sizes, in.contact,
                                        std::vector<int64_t>(count, -1), std::vector<double>(count),
                                        std::vector<double>(count, always), {}, 0);
  check_scenes(a_.contact, scenes);
  STD_TORCH_CHECK(a_.contact.obstacles > 0, "bodies must have obstacles, got none");
  STD_TORCH_CHECK(in.owner.size() == count, "body_owner must have an entry per obstacle, ", count, ", got ",
                  in.owner.size());
}

template <class T, int D>
void BodiesCall<T, D>::set_bodies(const BodiesInputs& in, const Tensor& like, int64_t scenes) {
  static_assert(sizeof(BodyConstants<D>) == BodyConstants<D>::width * sizeof(double));
  static_assert(sizeof(PartPose<D>) == PartPose<D>::width * sizeof(double));
  const int64_t K = int64_t(in.joint.size());
  STD_TORCH_CHECK(K > 0 && K <= a_.contact.obstacles, "body_joint must have an entry per body, 1 to ",
                  a_.contact.obstacles, ", got ", K);
  a_.scenes = int(scenes);
  a_.bodies = int(K);
  for (size_t o = 0; o < in.owner.size(); o++) {
    STD_TORCH_CHECK(in.owner[o] >= 0 && in.owner[o] < K, "body_owner must be below ", K, " and not negative, got ",
                    in.owner[o]);
    a_.owner[o] = int(in.owner[o]);
  }
  for (int64_t k = 0; k < K; k++) {
    const int64_t joint = in.joint[size_t(k)];
    STD_TORCH_CHECK(joint >= 0 && joint < int64_t(BodyJoint::count), "body_joint must be 0 to ",
                    int64_t(BodyJoint::count) - 1, ", got ", joint);
    a_.joint[k] = BodyJoint(joint);
  }
  a_.constants = reinterpret_cast<const BodyConstants<D>*>(
      doubles(given_[3], "constants of bodies", like, {K, BodyConstants<D>::width}));
  a_.parts = reinterpret_cast<const PartPose<D>*>(
      doubles(given_[4], "parts of bodies", like, {a_.contact.obstacles, PartPose<D>::width}));
  check_rank(given_[5], "gravity of bodies", 2);
  const int64_t of_gravity = given_[5].size(0) == 1 ? 1 : scenes;
  a_.gravity = doubles(given_[5], "gravity of bodies", like, {of_gravity, D});
  a_.gravity_rows = int(of_gravity);
  if (given_.size() == 7) a_.wrench = doubles(given_[6], "wrenches of bodies", like, {scenes, K, kMotions<D>});
  doubles(given_[0], "rows of bodies", like, {scenes, K, kBodyRow<D>});
  rows_ = empty(like, {scenes, K, kBodyRow<D>}, ScalarType::Double);
  torch::stable::copy_(rows_, given_[0]);
  a_.begin = a_.end = static_cast<double*>(rows_.data_ptr());
  report_ = empty(like, {scenes, 1 + K}, ScalarType::Double);
  torch::stable::zero_(report_);
  a_.report = static_cast<double*>(report_.data_ptr());
}

}  // namespace mpm
