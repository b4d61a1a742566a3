#include "kernels/soft/elasticity.h"

#include <algorithm>

#include "kernels/soft/damping.h"
#include "kernels/soft/material.h"

namespace diffsim {
namespace {

using Index = std::int64_t;
std::size_t at(Index i) { return static_cast<std::size_t>(i); }

// Groups per task: small enough to share, large enough that a task costs microseconds.
constexpr Index kTask = 16;
// Directions whose nodal vectors are held at once.
constexpr Index kDirections = 16;
// Groups whose element matrices are held at once while the tangent is assembled.
constexpr Index kChunk = 512;

Index num_tasks(Index count, Index size) { return (count + size - 1) / size; }

/// What the fibers of a group pull with: a tendon's stiffness is zero where it is slack.
template <typename Group>
FiberPull fiber_pull(const SoftModel& model, const SoftParameters& p, Index g,
                     const FiberState& f) {
  return fiber_pull(f, Group::element_value(model.fiber, g, p.fiber_stiffness),
                    Group::element_value(model.fiber, g, p.activation),
                    Group::element_value(model.fiber, g, model.fiber_pull_only.data()));
}

template <typename Group>
void fiber_directions(const SoftModel& model, Index g, Lane m[3]) {
  for (int i = 0; i < 3; ++i)
    m[i] = Group::element_value(model.fiber, g, model.fiber_directions.data(), 3, i);
}

/// Sums the vectors buffer into nodes, in element order whatever the number of threads.
void gather_vectors(const SoftModel& model, const double* vectors, double* out, ThreadPool& pool) {
  constexpr Index kNodesPerTask = 256;
  pool.run(num_tasks(model.num_nodes, kNodesPerTask), [&](Index task) {
    const Index stride = model.gather_stride;
    const Index last = std::min(model.num_nodes, (task + 1) * kNodesPerTask);
    for (Index i = task * kNodesPerTask; i < last; ++i) {
      double sum[3] = {0.0, 0.0, 0.0};
      for (Index k = model.gather_start[at(i)]; k < model.gather_start[at(i + 1)]; ++k) {
        const double* v = vectors + model.gather_offset[at(k)];
        for (int axis = 0; axis < 3; ++axis) sum[axis] += v[axis * stride];
      }
      for (int axis = 0; axis < 3; ++axis) out[3 * i + axis] = sum[axis];
    }
  });
}

/// Calls f(group) for all groups, in tasks of kTask.
template <typename F>
void for_groups(const ElementBlock& block, ThreadPool& pool, F&& f) {
  pool.run(num_tasks(block.num_groups, kTask), [&](Index task) {
    const Index last = std::min(block.num_groups, (task + 1) * kTask);
    for (Index g = task * kTask; g < last; ++g) f(g);
  });
}

template <typename Group, typename M>
double energy_gradient_of(const SoftModel& model, const SoftParameters& p,
                          const std::vector<DampingFrame>& frames, const double* x,
                          ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const ElementBlock& fiber = model.fiber;
  scratch.vectors.resize(at(model.vectors_size));
  scratch.partial.resize(at(solid.num_groups + fiber.num_groups));
  for_groups(solid, pool, [&](Index g) {
    Lane F[9], P[9];
    deformation_gradient<Group>(solid, g, x, F);
    const typename M::Sample sample(F);
    Lane psi = stress<M>(sample, Group::element_value(solid, g, p.w_mu),
                         Group::element_value(solid, g, p.w_vol), P);
    if (p.damp_mu) {
      Lane delta[9];
      const DampingFrame& frame = frames[at(g)];
      for (int i = 0; i < 9; ++i) delta[i] = F[i] - frame.Fv[i];
      psi += add_viscous_stress(frame.Fn, delta, Group::element_value(solid, g, p.damp_mu),
                                Group::element_value(solid, g, p.damp_lambda), P);
    }
    const auto& shape = Group::shape(solid, g);
    scatter_stress(shape, P, scratch.vectors.data() + g * solid.vectors_size());
    scratch.partial[at(g)] = sum(shape.weight * psi);
  });
  for_groups(fiber, pool, [&](Index g) {
    Lane F[9], P[9], m[3];
    deformation_gradient<Group>(fiber, g, x, F);
    fiber_directions<Group>(model, g, m);
    const FiberState f = fiber_state(F, m);
    const Lane psi = fiber_stress(f, fiber_pull<Group>(model, p, g, f), P);
    const auto& shape = Group::shape(fiber, g);
    scatter_stress(shape, P,
                   scratch.vectors.data() + model.fiber_vectors_start + g * fiber.vectors_size());
    scratch.partial[at(solid.num_groups + g)] = sum(shape.weight * psi);
  });
  double energy = 0.0;
  for (double e : scratch.partial) energy += e;
  return energy;
}

/// Element matrix K_ab = sum of weight grad_a^T H grad_b for a <= b, as 3x3 lanes.
template <int kNodes>
void element_matrix(const GroupShape<kNodes>& shape, const Lane H[81], Lane* K) {
  Lane T[27];  // H grad_b, (i, j, k)
  for (int b = 0; b < kNodes; ++b) {
    Lane g[3];
    for (int l = 0; l < 3; ++l) g[l] = shape.weight * shape.grad[b][l];
    for (int n = 0; n < 27; ++n) T[n] = H[3 * n] * g[0] + H[3 * n + 1] * g[1] + H[3 * n + 2] * g[2];
    for (int a = 0; a <= b; ++a) {
      Lane* out = K + 9 * (b * (b + 1) / 2 + a);
      for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
          out[3 * i + k] = shape.grad[a][0] * T[9 * i + k] + shape.grad[a][1] * T[9 * i + 3 + k] +
                           shape.grad[a][2] * T[9 * i + 6 + k];
    }
  }
}

/// Doubles that hold the element matrices of one group, padded to whole lanes.
template <typename Group>
constexpr Index matrix_size() {
  constexpr Index kPairs = Group::kNodes * (Group::kNodes + 1) / 2;
  return Group::kNodes == 8 ? (kPairs * 9 + 7) / 8 * 8 : kPairs * 9 * kLanes;
}

template <typename Group>
void store_matrix(Lane* K, double* out) {
  constexpr Index kEntries = Group::kNodes * (Group::kNodes + 1) / 2 * 9;
  if constexpr (Group::kNodes == 8) {
    for (Index k = kEntries; k < matrix_size<Group>(); ++k) K[k] = broadcast(0.0);
    for (Index k = 0; k < kEntries; k += 8) store(out + k, sum_each(K + k));
  } else {
    for (Index k = 0; k < kEntries; ++k) store(out + k * kLanes, K[k]);
  }
}

/// Adds the element matrices of groups [first, last) to rows, a fixed row range per thread: every
/// entry receives its contributions in element order.
template <typename Group>
void scatter_matrices(const SoftModel& model, const ElementBlock& block,
                      const std::vector<std::int32_t>& slots, const double* matrices, Index first,
                      Index last, double* values, ThreadPool& pool) {
  constexpr int n = Group::kNodes;
  constexpr Index per_group = Group::kNodes == 8 ? 1 : kLanes;
  const Index stride = per_group;
  const Index element_end = std::min(block.num_elements, last * per_group);
  const int parts = pool.size();
  pool.run(parts, [&](Index part) {
    const Index row_begin = model.num_nodes * part / parts;
    const Index row_end = model.num_nodes * (part + 1) / parts;
    const auto add = [&](Index row, std::int32_t slot, const double* k, bool transpose) {
      const Index width = model.strip_width(row);
      double* strip = values + model.strip_start[at(row)] + 3 * slot;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          strip[i * width + j] += k[(transpose ? 3 * j + i : 3 * i + j) * stride];
    };
    for (Index e = first * per_group; e < element_end; ++e) {
      const double* matrix =
          matrices + (e / per_group - first) * matrix_size<Group>() + e % per_group;
      const Index* node = block.nodes.data() + e * n;
      const std::int32_t* slot = slots.data() + e * n * n;
      for (int b = 0; b < n; ++b)
        for (int a = 0; a <= b; ++a) {
          const double* k = matrix + 9 * (b * (b + 1) / 2 + a) * stride;
          if (node[a] >= row_begin && node[a] < row_end) add(node[a], slot[a * n + b], k, false);
          if (a != b && node[b] >= row_begin && node[b] < row_end)
            add(node[b], slot[b * n + a], k, true);
        }
    }
  });
}

/// Assembles one block; fill(g, H) writes the (9, 9) tangent of a group's samples.
template <typename Group, typename Fill>
void assemble(const SoftModel& model, const ElementBlock& block,
              const std::vector<std::int32_t>& slots, Fill&& fill, double* values,
              ElasticityScratch& scratch, ThreadPool& pool) {
  scratch.blocks.resize(at(std::min(kChunk, block.num_groups) * matrix_size<Group>()));
  for (Index first = 0; first < block.num_groups; first += kChunk) {
    const Index last = std::min(block.num_groups, first + kChunk);
    pool.run(num_tasks(last - first, kTask), [&](Index task) {
      const Index end = std::min(last, first + (task + 1) * kTask);
      for (Index g = first + task * kTask; g < end; ++g) {
        Lane H[81], K[328];
        fill(g, H);
        element_matrix(Group::shape(block, g), H, K);
        store_matrix<Group>(K, scratch.blocks.data() + (g - first) * matrix_size<Group>());
      }
    });
    scatter_matrices<Group>(model, block, slots, scratch.blocks.data(), first, last, values, pool);
  }
}

template <typename Group, typename M>
void tangent_of(const SoftModel& model, const SoftParameters& p,
                const std::vector<DampingFrame>& frames, const double* x, bool clamp,
                double* values, ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const ElementBlock& fiber = model.fiber;
  const auto fill_solid = [&](Index g, Lane H[81]) {
    Lane F[9];
    deformation_gradient<Group>(solid, g, x, F);
    const typename M::Sample sample(F);
    PrincipalTangent core = M::tangent(sample, Group::element_value(solid, g, p.w_mu),
                                       Group::element_value(solid, g, p.w_vol));
    if (clamp) clamp_tangent(core);
    expand_tangent(sample, core, H);
    if (p.damp_mu)
      add_viscous_tangent(frames[at(g)].Fn, Group::element_value(solid, g, p.damp_mu),
                          Group::element_value(solid, g, p.damp_lambda), H);
  };
  const auto fill_fiber = [&](Index g, Lane H[81]) {
    Lane F[9], m[3];
    deformation_gradient<Group>(fiber, g, x, F);
    fiber_directions<Group>(model, g, m);
    const FiberState f = fiber_state(F, m);
    fiber_tangent(f, fiber_pull<Group>(model, p, g, f), clamp, H);
  };
  std::fill(values, values + model.values_size(), 0.0);
  assemble<Group>(model, solid, model.solid_slot, fill_solid, values, scratch, pool);
  assemble<Group>(model, fiber, model.fiber_slot, fill_fiber, values, scratch, pool);
}

Lane contract(const Lane A[9], const Lane B[9]) {
  Lane total = A[0] * B[0];
  for (int i = 1; i < 9; ++i) total += A[i] * B[i];
  return total;
}

/// Adjoint of the damping force. With Z = dz/dX, Y = sym(F_n^T Z) and S the strain rate:
///   z . grad D = Y : T(S),  d/dF_n = Z T(S) + delta T(Y),  d/dF_v = -F_n T(Y).
template <typename Group>
void damping_adjoint(const SoftModel& model, const SoftParameters& p,
                     const std::vector<DampingFrame>& frames, const double* x, const double* z,
                     const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  std::fill(scratch.vectors.begin(), scratch.vectors.end(), 0.0);
  // Two passes, since both nodal gradients go through the one vectors buffer.
  for (const bool frame_pass : {true, false}) {
    for_groups(solid, pool, [&](Index g) {
      Lane F[9], Z[9], delta[9], S[9], Y[9], TS[9], TY[9], A[9], B[9];
      const DampingFrame& frame = frames[at(g)];
      deformation_gradient<Group>(solid, g, x, F);
      deformation_gradient<Group>(solid, g, z, Z);
      for (int i = 0; i < 9; ++i) delta[i] = F[i] - frame.Fv[i];
      const Lane d_mu = Group::element_value(solid, g, p.damp_mu);
      const Lane d_lambda = Group::element_value(solid, g, p.damp_lambda);
      strain_rate(frame.Fn, delta, S);
      strain_rate(frame.Fn, Z, Y);
      viscous(S, d_mu, d_lambda, TS);
      viscous(Y, d_mu, d_lambda, TY);
      const auto& shape = Group::shape(solid, g);
      if (frame_pass) {
        const Lane traces = (Y[0] + Y[4] + Y[8]) * (S[0] + S[4] + S[8]);
        Group::add_element_value(solid, g, shape.weight * contract(Y, S), out.damp_mu);
        Group::add_element_value(solid, g, shape.weight * traces, out.damp_lambda);
        times(Z, TS, A);
        times(delta, TY, B);
        for (int i = 0; i < 9; ++i) A[i] += B[i];
      } else {
        times(frame.Fn, TY, A);
        for (int i = 0; i < 9; ++i) A[i] = -A[i];
      }
      scatter_stress(shape, A, scratch.vectors.data() + g * solid.vectors_size());
    });
    gather_vectors(model, scratch.vectors.data(), frame_pass ? out.x_frame : out.x_velocity, pool);
  }
}

template <typename Group, typename M>
void parameter_adjoint_of(const SoftModel& model, const SoftParameters& p,
                          const std::vector<DampingFrame>& frames, const double* x, const double* z,
                          const ParameterAdjoint& out, ElasticityScratch& scratch,
                          ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const ElementBlock& fiber = model.fiber;
  for_groups(solid, pool, [&](Index g) {
    Lane F[9], Z[9], P[9];
    deformation_gradient<Group>(solid, g, x, F);
    deformation_gradient<Group>(solid, g, z, Z);
    const typename M::Sample sample(F);
    const Lane weight = Group::shape(solid, g).weight;
    // The stress is linear in the weights: its derivative is the stress of unit weights.
    stress<M>(sample, broadcast(1.0), broadcast(0.0), P);
    Group::add_element_value(solid, g, weight * contract(P, Z), out.w_mu);
    stress<M>(sample, broadcast(0.0), broadcast(1.0), P);
    Group::add_element_value(solid, g, weight * contract(P, Z), out.w_vol);
  });
  for_groups(fiber, pool, [&](Index g) {
    Lane F[9], Z[9], m[3];
    deformation_gradient<Group>(fiber, g, x, F);
    deformation_gradient<Group>(fiber, g, z, Z);
    fiber_directions<Group>(model, g, m);
    const FiberState f = fiber_state(F, m);
    Lane along = broadcast(0.0);  // e . Z m
    for (int i = 0; i < 3; ++i)
      along += f.unit[i] * (Z[3 * i] * m[0] + Z[3 * i + 1] * m[1] + Z[3 * i + 2] * m[2]);
    const Lane weight = Group::shape(fiber, g).weight;
    const FiberPull pull = fiber_pull<Group>(model, p, g, f);
    Group::add_element_value(fiber, g, weight * pull.stretch * along, out.fiber_stiffness);
    Group::add_element_value(fiber, g, -weight * pull.stiffness * along, out.activation);
  });
  if (p.damp_mu) damping_adjoint<Group>(model, p, frames, x, z, out, scratch, pool);
}

/// Item k of a (count, size) array at a group; zero for null.
template <typename Group>
Lane direction_value(const ElementBlock& block, Index g, const double* values, Index k) {
  return values ? Group::element_value(block, g, values + k * block.num_elements) : broadcast(0.0);
}

/// Adds d(F_n T(S)) = dF_n T(S) + F_n (dT(S) + T(dS)), dS = sym(dF_n^T delta - F_n^T dF_v).
template <typename Group>
void add_damping_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrame& frame,
                         const Lane delta[9], Index g, Index k, const ParameterDirections& d,
                         Lane P[9]) {
  const ElementBlock& solid = model.solid;
  const Index size = 3 * model.num_nodes;
  const Lane d_mu = Group::element_value(solid, g, p.damp_mu);
  const Lane d_lambda = Group::element_value(solid, g, p.damp_lambda);
  Lane S[9], T[9], A[9];
  strain_rate(frame.Fn, delta, S);
  viscous(S, direction_value<Group>(solid, g, d.damp_mu, k),
          direction_value<Group>(solid, g, d.damp_lambda, k), T);
  Lane dS[9];
  for (int i = 0; i < 9; ++i) dS[i] = broadcast(0.0);
  if (d.x_frame) {
    Lane dFn[9], TS[9];
    deformation_gradient<Group>(solid, g, d.x_frame + k * size, dFn);
    strain_rate(dFn, delta, dS);
    viscous(S, d_mu, d_lambda, TS);
    times(dFn, TS, A);
    for (int i = 0; i < 9; ++i) P[i] += A[i];
  }
  if (d.x_velocity) {
    Lane dFv[9], B[9];
    deformation_gradient<Group>(solid, g, d.x_velocity + k * size, dFv);
    strain_rate(frame.Fn, dFv, B);
    for (int i = 0; i < 9; ++i) dS[i] -= B[i];
  }
  viscous(dS, d_mu, d_lambda, A);
  for (int i = 0; i < 9; ++i) T[i] += A[i];
  times(frame.Fn, T, A);
  for (int i = 0; i < 9; ++i) P[i] += A[i];
}

/// Directions [first, last) into their vectors buffers, one behind the other.
template <typename Group, typename M>
void parameter_tangent_of(const SoftModel& model, const SoftParameters& p,
                          const std::vector<DampingFrame>& frames, const double* x, Index first,
                          Index last, const ParameterDirections& d, double* vectors,
                          ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const ElementBlock& fiber = model.fiber;
  for_groups(solid, pool, [&](Index g) {
    Lane F[9], P_mu[9], P_vol[9], delta[9];
    deformation_gradient<Group>(solid, g, x, F);
    if (d.w_mu || d.w_vol) {
      // The stress is linear in the weights: its derivative is the stress of unit weights.
      const typename M::Sample sample(F);
      stress<M>(sample, broadcast(1.0), broadcast(0.0), P_mu);
      stress<M>(sample, broadcast(0.0), broadcast(1.0), P_vol);
    }
    if (p.damp_mu)
      for (int i = 0; i < 9; ++i) delta[i] = F[i] - frames[at(g)].Fv[i];
    const auto& shape = Group::shape(solid, g);
    for (Index k = first; k < last; ++k) {
      Lane P[9];
      for (int i = 0; i < 9; ++i) P[i] = broadcast(0.0);
      if (d.w_mu || d.w_vol) {
        const Lane mu = direction_value<Group>(solid, g, d.w_mu, k);
        const Lane vol = direction_value<Group>(solid, g, d.w_vol, k);
        for (int i = 0; i < 9; ++i) P[i] = mu * P_mu[i] + vol * P_vol[i];
      }
      if (p.damp_mu) add_damping_tangent<Group>(model, p, frames[at(g)], delta, g, k, d, P);
      scatter_stress(shape, P,
                     vectors + (k - first) * model.vectors_size + g * solid.vectors_size());
    }
  });
  for_groups(fiber, pool, [&](Index g) {
    Lane F[9], m[3];
    deformation_gradient<Group>(fiber, g, x, F);
    fiber_directions<Group>(model, g, m);
    const FiberState f = fiber_state(F, m);
    const FiberPull pull = fiber_pull<Group>(model, p, g, f);
    const auto& shape = Group::shape(fiber, g);
    for (Index k = first; k < last; ++k) {
      const Lane tension = direction_value<Group>(fiber, g, d.fiber_stiffness, k) * pull.stretch -
                           direction_value<Group>(fiber, g, d.activation, k) * pull.stiffness;
      Lane P[9];
      for (int i = 0; i < 9; ++i) P[i] = tension * f.unit[i / 3] * f.direction[i % 3];
      scatter_stress(shape, P,
                     vectors + (k - first) * model.vectors_size + model.fiber_vectors_start +
                         g * fiber.vectors_size());
    }
  });
}

/// Calls f(group, material) with the types of a model.
template <typename F>
decltype(auto) with_types(const SoftModel& model, F&& f) {
  return with_material(model.material, [&](auto material) -> decltype(auto) {
    return model.solid.is_hex ? f(HexGroup{}, material) : f(TetGroup{}, material);
  });
}

}  // namespace

std::vector<DampingFrame> damping_frames(const SoftModel& model, const double* x_frame,
                                         const double* x_velocity, ThreadPool& pool) {
  std::vector<DampingFrame> frames(at(model.solid.num_groups));
  const auto fill = [&](auto group) {
    using Group = decltype(group);
    for_groups(model.solid, pool, [&](Index g) {
      deformation_gradient<Group>(model.solid, g, x_frame, frames[at(g)].Fn);
      deformation_gradient<Group>(model.solid, g, x_velocity, frames[at(g)].Fv);
    });
  };
  model.solid.is_hex ? fill(HexGroup{}) : fill(TetGroup{});
  return frames;
}

double energy_gradient(const SoftModel& model, const SoftParameters& p,
                       const std::vector<DampingFrame>& frames, const double* x, double* gradient,
                       ElasticityScratch& scratch, ThreadPool& pool) {
  const double energy = with_types(model, [&](auto group, auto material) {
    return energy_gradient_of<decltype(group), decltype(material)>(model, p, frames, x, scratch,
                                                                   pool);
  });
  gather_vectors(model, scratch.vectors.data(), gradient, pool);
  return energy;
}

void tangent(const SoftModel& model, const SoftParameters& p,
             const std::vector<DampingFrame>& frames, const double* x, bool clamp, double* values,
             ElasticityScratch& scratch, ThreadPool& pool) {
  with_types(model, [&](auto group, auto material) {
    tangent_of<decltype(group), decltype(material)>(model, p, frames, x, clamp, values, scratch,
                                                    pool);
  });
}

void parameter_adjoint(const SoftModel& model, const SoftParameters& p,
                       const std::vector<DampingFrame>& frames, const double* x, const double* z,
                       const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool) {
  const auto clear = [](double* values, Index size) { std::fill(values, values + size, 0.0); };
  clear(out.w_mu, model.solid.num_elements);
  clear(out.w_vol, model.solid.num_elements);
  clear(out.fiber_stiffness, model.fiber.num_elements);
  clear(out.activation, model.fiber.num_elements);
  if (p.damp_mu) {
    clear(out.damp_mu, model.solid.num_elements);
    clear(out.damp_lambda, model.solid.num_elements);
  }
  scratch.vectors.resize(at(model.vectors_size));
  with_types(model, [&](auto group, auto material) {
    parameter_adjoint_of<decltype(group), decltype(material)>(model, p, frames, x, z, out, scratch,
                                                              pool);
  });
}

void parameter_tangent(const SoftModel& model, const SoftParameters& p,
                       const std::vector<DampingFrame>& frames, const double* x, Index count,
                       const ParameterDirections& directions, double* out,
                       ElasticityScratch& scratch, ThreadPool& pool) {
  scratch.vectors.resize(at(std::min(count, kDirections) * model.vectors_size));
  for (Index first = 0; first < count; first += kDirections) {
    const Index last = std::min(count, first + kDirections);
    with_types(model, [&](auto group, auto material) {
      parameter_tangent_of<decltype(group), decltype(material)>(
          model, p, frames, x, first, last, directions, scratch.vectors.data(), pool);
    });
    for (Index k = first; k < last; ++k)
      gather_vectors(model, scratch.vectors.data() + (k - first) * model.vectors_size,
                     out + 3 * k * model.num_nodes, pool);
  }
}

std::int64_t count_inverted(const SoftModel& model, const double* x) {
  std::vector<double> bad(at(model.solid.num_elements), 0.0);
  const auto count = [&](auto group) {
    using Group = decltype(group);
    for (Index g = 0; g < model.solid.num_groups; ++g) {
      Lane F[9];
      deformation_gradient<Group>(model.solid, g, x, F);
      const Lane det = F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) +
                       F[2] * (F[3] * F[7] - F[4] * F[6]);
      const Lane inverted = select<Lane>(less(broadcast(0.0), det), broadcast(0.0), broadcast(1.0));
      Group::add_element_value(model.solid, g, inverted, bad.data());
    }
  };
  model.solid.is_hex ? count(HexGroup{}) : count(TetGroup{});
  return std::count_if(bad.begin(), bad.end(), [](double n) { return n > 0.0; });
}

}  // namespace diffsim
