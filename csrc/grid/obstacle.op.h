#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "grid/shapes.h"
#include "grid/topology.op.h"

// Obstacles as the ops take them, packed by torch_mpm/ops/contact.py and unpacked here.
namespace mpm {

#define MPM_OBSTACLES_SCHEMA                                                                       \
  "Tensor obstacles, Tensor data, int[] shape, int[] sizes, int[] contact, int[] obstacle_scene, " \
  "float[] start, float[] end, Tensor? scene_time, float time"
#define MPM_OBSTACLES_PARAMETERS                                                                       \
  const Tensor &obstacles, const Tensor &data, std::vector<int64_t> shape, std::vector<int64_t> sizes, \
      std::vector<int64_t> contact_kind, std::vector<int64_t> scene, std::vector<double> start,        \
      std::vector<double> end, const OptionalTensor &scene_time, double time
#define MPM_OBSTACLES_ARGUMENTS obstacles, data, shape, sizes, contact_kind, scene, start, end, scene_time, time

#define MPM_CONTACT_WALLS_PARAMETERS const std::vector<int64_t>&wall_kind, const std::vector<double>&wall_plane

// The walls of the domain beside obstacles; all are open where the lists are empty.
template <class T, int D>
void set_walls(ContactArguments<T, D>& a, MPM_CONTACT_WALLS_PARAMETERS) {
  STD_TORCH_CHECK(wall_kind.empty() || wall_kind.size() == 2 * D, "wall_kind must be empty or have ", 2 * D,
                  " entries, two per axis, got ", wall_kind.size());
  STD_TORCH_CHECK(wall_plane.size() == wall_kind.size(), "wall_plane must have an entry per wall_kind, ",
                  wall_kind.size(), ", got ", wall_plane.size());
  for (int face = 0; face < 2 * D; face++) {
    const int64_t kind = wall_kind.empty() ? int64_t(Contact::open) : wall_kind[face];
    STD_TORCH_CHECK(kind >= int64_t(Contact::open) && kind <= int64_t(Contact::mirror),
                    "wall_kind must be 0 to 4, got ", kind);
    const bool bounded = kind != int64_t(Contact::open) && std::isfinite(wall_plane[face]);
    a.wall_kind[face] = bounded ? Contact(kind) : Contact::open;
    a.wall_plane[face] = T(bounded ? wall_plane[face] : 0);
  }
}

// What does not depend on the activation; `like` has the dtype and device of the nodes. A call of many steps may have
// obstacles for each of them.
template <class T, int D>
ContactArguments<T, D> obstacle_arguments(const Tensor& like, const PackedLattice& packed, MPM_OBSTACLES_PARAMETERS,
                                          int64_t steps = 0) {
  ContactArguments<T, D> a;
  a.geometry = packed.geometry<T, D>();
  a.dx = packed.dx();
  T largest = T(0);  // coordinate of a node
  for (int i = 0; i < D; i++) {
    a.lower[i] = packed.lower()[i];
    const double upper = a.lower[i] + a.dx * double(a.geometry.blocks[i] * kBlockWidth);
    largest = std::fmax(largest, T(std::fmax(std::fabs(a.lower[i]), std::fabs(upper))));
  }
  a.rounding = 16 * std::numeric_limits<T>::epsilon() * largest;
  constexpr int64_t width = ObstacleRow<T, D>::width;
  static_assert(sizeof(ObstacleRow<T, D>) == width * sizeof(T));
  const bool of_steps = steps > 0 && obstacles.dim() == 4;
  if (!of_steps) check_rank(obstacles, "obstacles", 3);
  check_like(obstacles, "obstacles", like);
  STD_TORCH_CHECK(!of_steps || obstacles.size(0) == steps, "obstacles must be given once or for each of ", steps,
                  " steps, got shape ", shape_of(obstacles));
  const int64_t first = of_steps ? 1 : 0, rows = obstacles.size(first), obstacles_of_row = obstacles.size(first + 1);
  STD_TORCH_CHECK(obstacles.is_contiguous() && rows > 0 && rows <= INT32_MAX && obstacles_of_row <= kMaxObstacles &&
                      obstacles.size(first + 2) == width,
                  "obstacles must be contiguous with shape ", of_steps ? "[n, 1 or B" : "[1 or B", ", at most ",
                  kMaxObstacles, ", ", width, "], got ", shape_of(obstacles));
  a.row = static_cast<const ObstacleRow<T, D>*>(obstacles.data_ptr());
  a.rows = int(rows);
  a.obstacles = int(obstacles_of_row);
  if (of_steps) a.step_stride = rows * obstacles_of_row;
  const size_t count = size_t(a.obstacles);
  const auto check_entries = [&](const auto& list, const char* name) {
    STD_TORCH_CHECK(list.size() == count, name, " must have an entry per obstacle, ", count, ", got ", list.size());
  };
  check_entries(shape, "shape");
  check_entries(sizes, "sizes");
  check_entries(contact_kind, "contact");
  check_entries(scene, "scene");
  check_entries(start, "start");
  check_entries(end, "end");
  int64_t number = 0;
  for (size_t k = 0; k < count; k++) {
    STD_TORCH_CHECK(shape[k] >= 0 && shape[k] < int64_t(ObstacleShape::count), "shape must be below ",
                    int64_t(ObstacleShape::count), " and not negative, got ", shape[k]);
    STD_TORCH_CHECK(sizes[k] >= 0 && sizes[k] <= INT32_MAX / kMaxObstacles,
                    "sizes must not be negative nor too large, got ", sizes[k]);
    STD_TORCH_CHECK(contact_kind[k] >= int64_t(Contact::sticky) && contact_kind[k] <= int64_t(Contact::separate),
                    "contact must be 1 to 3, got ", contact_kind[k]);
    STD_TORCH_CHECK(scene[k] >= -1 && scene[k] <= INT32_MAX, "scene must be -1 or a scene, got ", scene[k]);
    a.kind[k] = {
        ObstacleShape(shape[k]), Contact(contact_kind[k]), int(scene[k]), start[k], end[k], int(number), int(sizes[k])};
    number += sizes[k];
  }
  check_shape(data, "data", {number});
  check_like(data, "data", like);
  STD_TORCH_CHECK(data.is_contiguous(), "data must be contiguous, got shape ", shape_of(data));
  a.data = static_cast<const T*>(data.data_ptr());
  a.time = time;
  set_walls(a, {}, {});
  if (has(scene_time)) {
    check_rank(*scene_time, "scene_time", 1);
    check_type(*scene_time, "scene_time", ScalarType::Double, like);
    STD_TORCH_CHECK(scene_time->is_contiguous() && scene_time->size(0) > 0 && scene_time->size(0) <= INT32_MAX,
                    "scene_time must be contiguous with shape [1 or B], got ", shape_of(*scene_time));
    a.scene_time = static_cast<const double*>(scene_time->data_ptr());
    a.times = int(scene_time->size(0));
  }
  return a;
}

// Their parameters and times are given once or for each scene.
template <class T, int D>
void check_scenes(const ContactArguments<T, D>& a, int64_t scenes) {
  STD_TORCH_CHECK(a.rows == 1 || a.rows == scenes, "obstacles must have one row or a row per scene, B = ", scenes,
                  ", got ", a.rows);
  STD_TORCH_CHECK(!a.scene_time || a.times == 1 || a.times == scenes,
                  "scene_time must have one entry or an entry per scene, B = ", scenes, ", got ", a.times);
}

}  // namespace mpm
