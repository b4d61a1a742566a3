// Derivatives of the elastic force with respect to the energy's parameters.
#include "kernels/soft/damping.h"
#include "kernels/soft/hourglass.h"
#include "kernels/soft/shape_derivatives.h"
#include "kernels/soft/solid_law.h"

namespace diffsim {
namespace {

using namespace elements;

// Directions whose nodal vectors are held at once.
constexpr Index kDirections = 16;

/// Adjoint of the damping force. With Z = dz/dX, Y = sym(F_n^T Z) and S the strain rate:
///   z . grad D = Y : T(S),  d/dF_n = Z T(S) + delta T(Y),  d/dF_v = -F_n T(Y).
template <typename Group>
void damping_adjoint_of(const SoftModel& model, const SoftParameters& p,
                        const DampingFrames& frames, const double* x, const double* z,
                        const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  std::fill(scratch.vectors.begin(), scratch.vectors.end(), 0.0);
  // Two passes, since both nodal gradients go through the one vectors buffer.
  for (const bool frame_pass : {true, false}) {
    for_groups(solid, pool, [&](Index g) {
      Native F[kParts][9], Z[kParts][9], A[kParts][9], products[kParts], traces[kParts];
      deformation_gradient<Group>(solid, g, x, F);
      deformation_gradient<Group>(solid, g, z, Z);
      const auto& shape = Group::shape(solid, g);
      for (int part = 0; part < kParts; ++part) {
        Native Fn[9], delta[9], S[9], Y[9], TS[9], TY[9], B[9];
        split_matrix(frames.solid[at(g)].Fn, part, Fn);
        split_matrix(frames.solid[at(g)].Fv, part, delta);
        for (int i = 0; i < 9; ++i) delta[i] = F[part][i] - delta[i];
        const Native d_mu = Group::part_value(solid, g, part, p.damp_mu);
        const Native d_lambda = Group::part_value(solid, g, part, p.damp_lambda);
        strain_rate(Fn, delta, S);
        strain_rate(Fn, Z[part], Y);
        viscous(S, d_mu, d_lambda, TS);
        viscous(Y, d_mu, d_lambda, TY);
        if (frame_pass) {
          const Native weight = split(shape.weight, part);
          products[part] = weight * contract(Y, S);
          traces[part] = weight * (Y[0] + Y[4] + Y[8]) * (S[0] + S[4] + S[8]);
          times(Z[part], TS, A[part]);
          times(delta, TY, B);
          for (int i = 0; i < 9; ++i) A[part][i] += B[i];
        } else {
          times(Fn, TY, A[part]);
          for (int i = 0; i < 9; ++i) A[part][i] = -A[part][i];
        }
      }
      if (frame_pass) {
        Group::add_element_value(solid, g, products, out.damp_mu);
        Group::add_element_value(solid, g, traces, out.damp_lambda);
      }
      scatter_stress(Group{}, shape, A, scratch.vectors.data() + g * solid.vectors_size());
    });
    hourglass::add_damping_adjoint(model, p, frames, x, z, frame_pass, out, scratch.vectors.data(),
                                   pool);
    gather_vectors(model, scratch.vectors.data(), frame_pass ? out.x_frame : out.x_velocity, pool);
  }
}

template <typename Group, typename M>
void weight_adjoint_of(const SoftModel& model, const double* x, const double* z, double* out,
                       ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const KeptSamples<M> kept = kept_samples<M>(scratch, model, x);
  for_stages(solid, pool, [&](Index first, int count) {
    const Stage<Group, M> stage(solid, first, count, x, kept, false);
    for (int n = 0; n < count; ++n) {
      const Index g = first + n;
      Native Z[kParts][9], by_weight[M::kWeights][kParts];
      deformation_gradient<Group>(solid, g, z, Z);
      for (int part = 0; part < kParts; ++part) {
        const auto& sample = stage.sample(n * kParts + part);
        const Native weight = split(Group::shape(solid, g).weight, part);
        Native products[M::kWeights];
        unit_products<M>(sample, Z[part], products);
        for (int k = 0; k < M::kWeights; ++k) by_weight[k][part] = weight * products[k];
      }
      add_weights<Group, M>(solid, g, by_weight, out);
    }
  });
}

template <typename Group>
void fiber_adjoint_of(const SoftModel& model, const SoftParameters& p, const double* x,
                      const double* z, const ParameterAdjoint& out, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    Native F[kParts][9], Z[kParts][9], by_stiffness[kParts], by_activation[kParts];
    deformation_gradient<Group>(fiber, g, x, F);
    deformation_gradient<Group>(fiber, g, z, Z);
    for (int part = 0; part < kParts; ++part) {
      const FiberPart f = fiber_part<Group>(model, p, g, part, F[part]);
      const Native* m = f.state.direction;
      Native along{};  // e . Z m
      for (int i = 0; i < 3; ++i)
        along += f.state.unit[i] *
                 (Z[part][3 * i] * m[0] + Z[part][3 * i + 1] * m[1] + Z[part][3 * i + 2] * m[2]);
      const Native weight = split(Group::shape(fiber, g).weight, part);
      by_stiffness[part] = weight * f.pull.stretch * along;
      by_activation[part] = -weight * f.pull.stiffness * along;
    }
    if (out.fiber_stiffness) Group::add_element_value(fiber, g, by_stiffness, out.fiber_stiffness);
    Group::add_element_value(fiber, g, by_activation, out.activation);
  });
}

/// Deformation gradients of item k of a (count, num_nodes, 3) array; zero for null.
template <typename Group>
void direction_gradient(const SoftModel& model, Index g, const double* values, Index k,
                        Native out[kParts][9]) {
  if (values)
    deformation_gradient<Group>(model.solid, g, values + 3 * k * model.num_nodes, out);
  else
    for (int i = 0; i < 9 * kParts; ++i) out[i / 9][i % 9] = Native{};
}

/// Adds d(F_n T(S)) = dF_n T(S) + F_n (dT(S) + T(dS)), dS = sym(dF_n^T delta - F_n^T dF_v).
template <typename Group>
void add_damping_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrame& frame,
                         const Native (*F)[9], Index g, Index k, const ParameterDirections& d,
                         Native (*P)[9]) {
  const ElementBlock& solid = model.solid;
  Native dFn[kParts][9], dFv[kParts][9];
  direction_gradient<Group>(model, g, d.x_frame, k, dFn);
  direction_gradient<Group>(model, g, d.x_velocity, k, dFv);
  for (int part = 0; part < kParts; ++part) {
    Native Fn[9], delta[9], S[9], dS[9], T[9], A[9], B[9];
    split_matrix(frame.Fn, part, Fn);
    split_matrix(frame.Fv, part, delta);
    for (int i = 0; i < 9; ++i) delta[i] = F[part][i] - delta[i];
    const Native d_mu = Group::part_value(solid, g, part, p.damp_mu);
    const Native d_lambda = Group::part_value(solid, g, part, p.damp_lambda);
    strain_rate(Fn, delta, S);
    viscous(S, d_mu, d_lambda, T);
    times(dFn[part], T, A);
    for (int i = 0; i < 9; ++i) P[part][i] += A[i];
    strain_rate(dFn[part], delta, dS);
    strain_rate(Fn, dFv[part], B);
    for (int i = 0; i < 9; ++i) dS[i] -= B[i];
    viscous(S, direction_value<Group>(solid, g, part, d.damp_mu, k),
            direction_value<Group>(solid, g, part, d.damp_lambda, k), T);
    viscous(dS, d_mu, d_lambda, A);
    for (int i = 0; i < 9; ++i) T[i] += A[i];
    times(Fn, T, A);
    for (int i = 0; i < 9; ++i) P[part][i] += A[i];
  }
}

/// Stresses of unit weights, at every part of a stage.
struct UnitStresses {
  Native P[kStageParts][kMostWeights][9];

  template <typename Group>
  UnitStresses(const SolidLaw& law, const LawStage<Group>& stage, int parts) {
    for (int r = 0; r < parts; ++r) law.unit_stresses(stage.sample(r), P[r]);
  }
};

/// Directions [first, last) into their vectors buffers, one behind the other.
template <typename Group>
void solid_tangent_of(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                      const double* x, Index first, Index last, const ParameterDirections& d,
                      double* vectors, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const SolidLaw law(model);
  for_stages(solid, pool, [&](Index begin, int count) {
    const LawStage<Group> stage(law, solid, begin, count, x);
    const UnitStresses unit(law, stage, count * kParts);
    for (int n = 0; n < count; ++n) {
      const Index g = begin + n;
      for (Index k = first; k < last; ++k) {
        Native P[kParts][9];
        for (int part = 0; part < kParts; ++part) {
          const LawWeights w = law.weights_along<Group>(model, g, part, d.weights, k);
          const Native(*own)[9] = unit.P[n * kParts + part];
          for (int i = 0; i < 9; ++i) {
            P[part][i] = w[0] * own[0][i] + w[1] * own[1][i];
            for (int m = 2; m < law.num_weights; ++m) P[part][i] += w[at(m)] * own[m][i];
          }
        }
        if (p.damp_mu)
          add_damping_tangent<Group>(model, p, frames.solid[at(g)], stage.F + n * kParts, g, k, d,
                                     P);
        scatter_stress(Group{}, Group::shape(solid, g), P,
                       vectors + (k - first) * model.vectors_size + g * solid.vectors_size());
      }
    }
  });
}

template <typename Group>
void fiber_tangent_of(const SoftModel& model, const SoftParameters& p, const double* x, Index first,
                      Index last, const ParameterDirections& d, double* vectors, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    Native F[kParts][9];
    deformation_gradient<Group>(fiber, g, x, F);
    FiberPart f[kParts];
    for (int part = 0; part < kParts; ++part)
      f[part] = fiber_part<Group>(model, p, g, part, F[part]);
    for (Index k = first; k < last; ++k) {
      Native P[kParts][9];
      for (int part = 0; part < kParts; ++part) {
        const Native tension =
            direction_value<Group>(fiber, g, part, d.fiber_stiffness, k) * f[part].pull.stretch -
            direction_value<Group>(fiber, g, part, d.activation, k) * f[part].pull.stiffness;
        for (int i = 0; i < 9; ++i)
          P[part][i] = tension * f[part].state.unit[i / 3] * f[part].state.direction[i % 3];
      }
      scatter_stress(Group{}, Group::shape(fiber, g), P,
                     vectors + (k - first) * model.vectors_size + model.fiber_vectors_start +
                         g * fiber.vectors_size());
    }
  });
}

/// The energy is linear in weights and stiffnesses: its slopes are the energies of units.
template <typename Group>
void solid_slopes_of(const SoftModel& model, const double* x, double* out,
                     ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const SolidLaw law(model, x, &scratch);
  for_stages(solid, pool, [&](Index first, int count) {
    const LawStage<Group> stage(law, solid, first, count, x, false);
    for (int n = 0; n < count; ++n) {
      const Index g = first + n;
      Native by_weight[kMostWeights][kParts], psi[kMostWeights];
      for (int part = 0; part < kParts; ++part) {
        law.unit_energies(stage.sample(n * kParts + part), psi);
        const Native weight = split(Group::shape(solid, g).weight, part);
        for (int k = 0; k < law.num_weights; ++k) by_weight[k][part] = weight * psi[k];
      }
      law.add_weights<Group>(solid, g, by_weight, out);
    }
  });
}

template <typename Group>
void fiber_slopes_of(const SoftModel& model, const SoftParameters& p, const double* x,
                     const ParameterAdjoint& out, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    Native F[kParts][9], by_stiffness[kParts], by_activation[kParts];
    deformation_gradient<Group>(fiber, g, x, F);
    for (int part = 0; part < kParts; ++part) {
      const FiberPull<Native> pull = fiber_part<Group>(model, p, g, part, F[part]).pull;
      const Native weight = split(Group::shape(fiber, g).weight, part);
      by_stiffness[part] = 0.5 * weight * pull.stretch * pull.stretch;
      by_activation[part] = -weight * pull.stiffness * pull.stretch;
    }
    Group::add_element_value(fiber, g, by_stiffness, out.fiber_stiffness);
    Group::add_element_value(fiber, g, by_activation, out.activation);
  });
}

void clear_elastic(const SoftModel& model, const ParameterAdjoint& out) {
  if (out.weights) std::fill(out.weights, out.weights + model.weights_size(), 0.0);
  if (out.fiber_stiffness)
    std::fill(out.fiber_stiffness, out.fiber_stiffness + model.fiber.num_elements, 0.0);
  std::fill(out.activation, out.activation + model.fiber.num_elements, 0.0);
}

}  // namespace

void energy_slopes(const SoftModel& model, const SoftParameters& p, const double* x,
                   const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool) {
  clear_elastic(model, out);
  with_group(model.solid, [&](auto group) {
    using Group = decltype(group);
    solid_slopes_of<Group>(model, x, out.weights, scratch, pool);
    fiber_slopes_of<Group>(model, p, x, out, pool);
  });
  hourglass::add_energy_slopes(model, x, out.weights, pool);
  shape_slopes(model, p, x, out, pool);
}

void parameter_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                       const double* z, const ParameterAdjoint& out, ElasticityScratch& scratch,
                       ThreadPool& pool) {
  clear_elastic(model, out);
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    if (out.weights)
      weight_adjoint_of<Group, decltype(material)>(model, x, z, out.weights, scratch, pool);
    fiber_adjoint_of<Group>(model, p, x, z, out, pool);
  });
  if (out.weights) hourglass::add_parameter_adjoint(model, x, z, out.weights, pool);
}

void damping_adjoint(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                     const double* x, const double* z, const ParameterAdjoint& out,
                     ElasticityScratch& scratch, ThreadPool& pool) {
  if (!p.damp_mu) return;
  std::fill(out.damp_mu, out.damp_mu + model.solid.num_elements, 0.0);
  std::fill(out.damp_lambda, out.damp_lambda + model.solid.num_elements, 0.0);
  scratch.vectors.resize(at(model.vectors_size));
  with_group(model.solid, [&](auto group) {
    damping_adjoint_of<decltype(group)>(model, p, frames, x, z, out, scratch, pool);
  });
}

void parameter_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, Index count, const ParameterDirections& directions,
                       double* out, ElasticityScratch& scratch, ThreadPool& pool) {
  scratch.vectors.resize(at(std::min(count, kDirections) * model.vectors_size));
  for (Index first = 0; first < count; first += kDirections) {
    const Index last = std::min(count, first + kDirections);
    with_group(model.solid, [&](auto group) {
      using Group = decltype(group);
      solid_tangent_of<Group>(model, p, frames, x, first, last, directions, scratch.vectors.data(),
                              pool);
      fiber_tangent_of<Group>(model, p, x, first, last, directions, scratch.vectors.data(), pool);
    });
    for (Index k = first; k < last; ++k)
      hourglass::add_parameter_tangent(model, p, frames, x, k, directions,
                                       scratch.vectors.data() + (k - first) * model.vectors_size,
                                       pool);
    for (Index k = first; k < last; ++k)
      add_shape_tangent(model, p, frames, x, nullptr, k, directions,
                        scratch.vectors.data() + (k - first) * model.vectors_size, pool);
    for (Index k = first; k < last; ++k)
      gather_vectors(model, scratch.vectors.data() + (k - first) * model.vectors_size,
                     out + 3 * k * model.num_nodes, pool);
  }
}

}  // namespace diffsim
