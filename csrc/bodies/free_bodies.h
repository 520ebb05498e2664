#pragma once

#include "bodies/body_nodes.h"

// Free bodies and material: the velocities U of the bodies of a scene at the end of a step are solved for together with
// the contact of the nodes, U = U* + W p(U), with the velocity U* without the material, the mobility W and the impulses
// p of the nodes. Newton's method, 3 or 6 unknowns of each body. −dp/dU is the mass of the nodes that follow the
// bodies, so that light bodies are stable at the time step of the material. Impulses change momentum on both sides
// alike, whether or not the solution has converged.
namespace mpm {

template <class T, int D>
struct FreeBodiesArguments {
  // Of the obstacles of all bodies, with friction and shape in their rows; with the mass of the nodes.
  ContactArguments<T, D> contact;
  // On CUDA: slots before those of the margin of an activation; both are in the order of their blocks.
  int first_slots = 0;
  T* velocity = nullptr;  // of node i at velocity + i * stride, changed in place
  int64_t stride = 0;
  int scenes = 0, bodies = 0;
  int owner[kMaxObstacles];                     // the body of an obstacle
  BodyJoint joint[kMaxObstacles];               // of a body
  const BodyConstants<D>* constants = nullptr;  // [bodies]
  const PartPose<D>* parts = nullptr;           // [obstacles]
  const double* gravity = nullptr;              // [gravity_rows, D] [m/s²]
  int gravity_rows = 0;                         // 1, or one per scene
  const double* wrench = nullptr;               // [scenes, bodies, kMotions] [N, N m], or null
  const double* begin = nullptr;                // rows [scenes, bodies, kBodyRow] at the beginning of the step, and
  double* end = nullptr;                        // at its end, which may be the same
  double* report = nullptr;  // [scenes, 1 + bodies]: the most iterations and the largest residuals so far
  // The solution U [scenes, bodies, kMotions], and dp/dU there [scenes, m, m] of the m unknowns of a scene; or null.
  double *motion = nullptr, *slopes = nullptr;
  double dt = 0, tolerance = 0;
  const T* scene_dt = nullptr;  // [scenes] factors of dt, or null
  int max_iterations = 0;
  char* workspace = nullptr;  // of the bytes that `free_bodies_workspace` returns
};

inline namespace TORCH_MPM_ISA {

// Numbers of a scene of K bodies with m unknowns together.
struct SceneNumbers {
  double *U, *trial, *impulse, *trial_impulse, *residual, *trial_residual;  // [m]
  double *size, *trial_size, *scale;                                        // [K]
  double* slopes;                                                           // dp/dU [m, m]
  double* matrix;                                                           // [m, m + 1]

  MPM_HD static int64_t count(int bodies, int m) { return 3 * bodies + 6 * m + int64_t(m) * (2 * m + 1); }
  MPM_HD SceneNumbers(double* memory, int bodies, int m)
      : U(memory),
        trial(U + m),
        impulse(trial + m),
        trial_impulse(impulse + m),
        residual(trial_impulse + m),
        trial_residual(residual + m),
        size(trial_residual + m),
        trial_size(size + bodies),
        scale(trial_size + bodies),
        slopes(scale + bodies),
        matrix(slopes + m * m) {}
};

MPM_HD void swap_pointers(double*& a, double*& b) {
  double* const c = a;
  a = b, b = c;
}

// Solves the linear system of a matrix [m, m + 1], whose last column is the right side and becomes the solution, by
// elimination with pivots (Gauss and Jordan). `team` as for SceneBodies.
template <class Team>
MPM_HD void solve_in_place(const Team& team, double* matrix, int m) {
  const int width = m + 1;
  MPM_LOOP for (int k = 0; k < m; k++) {
    int pivot = k;
    MPM_LOOP for (int i = k + 1; i < m; i++)
      if (abs(matrix[i * width + k]) > abs(matrix[pivot * width + k])) pivot = i;
    if (pivot != k) {
      team.sync();  // all have read the column
      team.each(width - k, [&](int j) {
        double &upper = matrix[k * width + k + j], &lower = matrix[pivot * width + k + j];
        const double kept = upper;
        upper = lower, lower = kept;
      });
      team.sync();
    }
    const int columns = m - k;
    const double inverse = 1 / matrix[k * width + k];
    team.each((m - 1) * columns, [&](int e) {
      const int other = e / columns, i = other < k ? other : other + 1, j = k + 1 + e % columns;
      matrix[i * width + j] -= matrix[i * width + k] * inverse * matrix[k * width + j];
    });
    team.sync();
  }
  team.each(m, [&](int i) { matrix[i * width + m] /= matrix[i * width + i]; });
  team.sync();
}

// The memory of a scene for its bodies and their obstacles.
template <class T, int D>
struct SceneMemory {
  BodyNow<D>* now;            // [bodies]
  ObstacleRow<T, D>* rows;    // [obstacles], with their positions and present velocities
  ObstaclePose<T, D>* poses;  // [obstacles], of these rows
  double* numbers;            // [SceneNumbers::count]
};

// The bodies of one scene. A team of threads calls all functions together: `team.each(count, f)` calls f(i) for each
// number, and `team.sync()` waits for all threads. `add_up(scene, impulses, slopes)` computes the sums over the nodes,
// which are complete on return; a null pointer skips its sums. `change_nodes(scene)` changes the velocities.
template <class T, int D, class Team>
class SceneBodies {
 public:
  static constexpr int n = kMotions<D>;

  MPM_HD SceneBodies(const FreeBodiesArguments<T, D>& arguments, int scene, const SceneMemory<T, D>& memory,
                     const Team& team)
      : a(arguments),
        now(memory.now),
        poses(memory.poses),
        scene_(scene),
        m_(a.bodies * n),
        rows_(memory.rows),
        s_(memory.numbers, a.bodies, m_),
        team_(team) {}

  const FreeBodiesArguments<T, D>& a;
  const BodyNow<D>* const now;
  const ObstaclePose<T, D>* const poses;

  // Reads the bodies, and places their obstacles at rest.
  MPM_HD static void begin(const FreeBodiesArguments<T, D>& a, int scene, const SceneMemory<T, D>& memory,
                           const Team& team) {
    team.each(a.bodies, [&](int k) {
      const double* const gravity = a.gravity + (a.gravity_rows == 1 ? 0 : int64_t(scene) * D);
      const int64_t body = int64_t(scene) * a.bodies + k;
      memory.now[k] = body_now(a.constants[k], a.joint[k], a.begin + body * kBodyRow<D>, gravity,
                               a.wrench ? a.wrench + body * n : nullptr, dt_of(a, scene));
    });
    team.sync();
    team.each(a.contact.obstacles, [&](int o) {
      const int64_t given = a.contact.rows == 1 ? o : int64_t(scene) * a.contact.obstacles + o;
      memory.rows[o] = a.contact.row[given];
      place_part(memory.now[a.owner[o]], a.parts[o], memory.rows[o]);
      memory.poses[o] = obstacle_pose(a.contact, a.contact.kind[o], memory.rows[o], scene);
    });
    team.sync();
  }

  // Solves for the velocities, changes the nodes and writes rows and report. After `begin`, once the nodes are known.
  MPM_HD void solve() {
    team_.each(m_, [&](int i) { s_.U[i] = now[i / n].predicted[i % n]; });
    team_.sync();
    evaluate(s_.U, s_.impulse, s_.residual, s_.size, s_.slopes);
    team_.each(a.bodies, [&](int k) {
      s_.scale[k] = size_of_motion(now[k], now[k].predicted) + s_.size[k] + std::numeric_limits<double>::min();
    });
    team_.sync();
    int iterations = 0;
    bool has_slopes = true, moves = true;  // whether slopes are those of U, and obstacles move by U
    double share = 1;
    MPM_LOOP while (iterations < a.max_iterations && !is_converged()) {
      iterations++;
      if (!has_slopes) team_.add_up(*this, nullptr, s_.slopes);
      has_slopes = true;
      find_step();
      team_.each(m_, [&](int i) { s_.trial[i] = s_.U[i] - share * s_.matrix[i * (m_ + 1) + m_]; });
      team_.sync();
      evaluate(s_.trial, s_.trial_impulse, s_.trial_residual, s_.trial_size, nullptr);
      moves = norm(s_.trial_size, a.bodies) < norm(s_.size, a.bodies);
      share = moves ? 1 : 0.5 * share;
      if (moves) take_trial();
      if (moves) has_slopes = false;
      team_.sync();
    }
    if (!moves) move_parts(s_.U);
    if (a.motion) write_solution(has_slopes);
    team_.change_nodes(*this);
    team_.each(a.bodies, [&](int k) { finish(k, iterations); });
  }

 private:
  const int scene_, m_;  // number of unknowns
  ObstacleRow<T, D>* const rows_;
  SceneNumbers s_;
  const Team& team_;

  MPM_HD static double dt_of(const FreeBodiesArguments<T, D>& a, int scene) {
    return a.scene_dt ? a.dt * double(a.scene_dt[scene]) : a.dt;
  }
  MPM_HD int64_t body(int k) const { return int64_t(scene_) * a.bodies + k; }

  MPM_HD static double norm(const double* values, int count) {
    double squared = 0;
    MPM_LOOP for (int i = 0; i < count; i++)
      squared += values[i] * values[i];
    return sqrt(squared);
  }

  MPM_HD void take_trial() {
    swap_pointers(s_.U, s_.trial);
    swap_pointers(s_.impulse, s_.trial_impulse);
    swap_pointers(s_.residual, s_.trial_residual);
    swap_pointers(s_.size, s_.trial_size);
  }

  MPM_HD bool is_converged() const {
    bool converged = true;
    MPM_LOOP for (int k = 0; k < a.bodies; k++)
      converged = converged && s_.size[k] <= 0.1 * a.tolerance * s_.scale[k];
    return converged;
  }

  MPM_HD void move_parts(const double* U) {
    team_.each(a.contact.obstacles,
               [&](int o) { move_part(now[a.owner[o]], a.parts[o], U + a.owner[o] * n, rows_[o]); });
    team_.sync();
  }

  // Impulses, residual U − U* − W p and its size for each body, of velocities U; and the slopes, unless null.
  MPM_HD_CALL void evaluate(const double* U, double* impulse, double* residual, double* size, double* slopes) {
    move_parts(U);
    team_.add_up(*this, impulse, slopes);
    team_.each(a.bodies, [&](int k) {
      for (int i = 0; i < n; i++)
        residual[k * n + i] = U[k * n + i] - now[k].predicted[i] - applied(now[k], impulse + k * n, i);
      size[k] = size_of_motion(now[k], residual + k * n);
    });
    team_.sync();
  }

  // The step of Newton's method, in the last column of the matrix 1 − W dp/dU. Velocities are rounded to the type of
  // the nodes, whose impulses change accordingly: residuals below that count as zero.
  MPM_HD void find_step() {
    const int width = m_ + 1;
    team_.each(m_, [&](int i) {
      const int k = i / n;
      double squared = 0;
      for (int j = 0; j < m_; j++) {
        double sum = 0;
        for (int l = 0; l < n; l++) sum += now[k].mobility[i % n][l] * s_.slopes[(k * n + l) * m_ + j];
        squared += sum * sum;
        s_.matrix[i * width + j] = (i == j ? 1 : 0) - sum;
      }
      s_.matrix[i * width + m_] = s_.residual[i];
      s_.trial_residual[i] = sqrt(squared);
    });
    team_.sync();
    const double rounded = double(std::numeric_limits<T>::epsilon()) * norm(s_.trial_residual, m_);
    team_.each(a.bodies, [&](int k) {
      s_.scale[k] = max(s_.scale[k], rounded * size_of_motion(now[k], s_.U + k * n) / a.tolerance);
    });
    solve_in_place(team_, s_.matrix, m_);
  }

  MPM_HD void write_solution(bool has_slopes) {
    if (!has_slopes) team_.add_up(*this, nullptr, s_.slopes);
    const int64_t first = int64_t(scene_) * m_;
    team_.each(m_, [&](int i) { a.motion[first + i] = s_.U[i]; });
    team_.each(m_ * m_, [&](int e) { a.slopes[first * m_ + e] = s_.slopes[e]; });
    team_.sync();
  }

  // The row of a body at the end of the step, by its impulses, and its report.
  MPM_HD void finish(int k, int iterations) {
    double motion[n];
    for (int i = 0; i < n; i++) motion[i] = now[k].predicted[i] + applied(now[k], s_.impulse + k * n, i);
    end_of_step(a.constants[k], a.joint[k], now[k], motion, dt_of(a, scene_), a.end + body(k) * kBodyRow<D>);
    double* const report = a.report + int64_t(scene_) * (1 + a.bodies);
    const double residual = s_.size[k] / s_.scale[k], before = report[1 + k];
    if (before == before && !(residual <= before)) report[1 + k] = residual;  // NaN stays
    if (k == 0) report[0] = max(report[0], double(iterations));
  }
};

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
