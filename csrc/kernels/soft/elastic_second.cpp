#include "kernels/soft/elastic_second.h"

#include "kernels/soft/damping.h"
#include "kernels/soft/element_stage.h"
#include "kernels/soft/stress_jets.h"

namespace diffsim {
namespace {

using namespace elements;

/// U^T A V.
template <class T>
void into_frame(const PrincipalFrame<T>& frame, const T A[9], T out[9]) {
  T AV[9];
  times(A, frame.V, AV);
  transpose_times(frame.U, AV, out);
}

/// Z : (P + dP[D]) of a law of unit weight, and its d^2P[Z, D] added with a weight.
template <class T>
T take(const Jet<T> P[9], const T Z[9], const T& weight, T mixed[9]) {
  T total = broadcast<T>(0.0);
  for (int i = 0; i < 9; ++i) {
    total += Z[i] * (P[i].v + P[i].b);
    mixed[i] += weight * P[i].ab;
  }
  return total;
}

template <typename Group, typename M>
void solid_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* z, const ParameterAdjoint& out,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const KeptFrames kept = kept_frames(scratch, model, x);
  for_stages(solid, pool, [&](Index first, int count) {
    const Stage<Group> stage(solid, first, count, x, kept, false);
    for (int n = 0; n < count; ++n) {
      const Index g = first + n;
      Native Z[kParts][9], D[kParts][9], P[kParts][9], by_mu[kParts], by_vol[kParts];
      deformation_gradient<Group>(solid, g, z, Z);
      deformation_gradient<Group>(solid, g, d, D);
      const auto& shape = Group::shape(solid, g);
      for (int part = 0; part < kParts; ++part) {
        const PrincipalFrame<Native>& frame = stage.frame(n * kParts + part);
        const typename M::template Sample<Native> sample(frame);
        Native Zp[9], Dp[9], mixed[9] = {}, turned[9];
        into_frame(frame, Z[part], Zp);
        into_frame(frame, D[part], Dp);
        Jet<Native> F[9], mu[9], vol[9];
        for (int i = 0; i < 9; ++i)
          F[i] = {i % 4 == 0 ? frame.s[i / 4] : Native{}, Zp[i], Dp[i], Native{}};
        stress_jets(M{}, sample, F, mu, vol);
        const Native weight = split(shape.weight, part);
        by_mu[part] = weight * take(mu, Zp, Group::part_value(solid, g, part, p.w_mu), mixed);
        by_vol[part] = weight * take(vol, Zp, Group::part_value(solid, g, part, p.w_vol), mixed);
        times(frame.U, mixed, turned);
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j)
            P[part][3 * i + j] = turned[3 * i] * frame.V[3 * j] +
                                 turned[3 * i + 1] * frame.V[3 * j + 1] +
                                 turned[3 * i + 2] * frame.V[3 * j + 2];
      }
      Group::add_element_value(solid, g, by_mu, out.w_mu);
      Group::add_element_value(solid, g, by_vol, out.w_vol);
      scatter_stress(shape, P, scratch.vectors.data() + g * solid.vectors_size());
    }
  });
}

template <typename Group>
void fiber_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* z, const ParameterAdjoint& out,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    Native F[kParts][9], Z[kParts][9], D[kParts][9], P[kParts][9];
    Native by_stiffness[kParts], by_activation[kParts];
    deformation_gradient<Group>(fiber, g, x, F);
    deformation_gradient<Group>(fiber, g, z, Z);
    deformation_gradient<Group>(fiber, g, d, D);
    const auto& shape = Group::shape(fiber, g);
    for (int part = 0; part < kParts; ++part) {
      const FiberPart f = fiber_part<Group>(model, p, g, part, F[part]);
      const Native* m = f.state.direction;
      const Native activation = Group::part_value(fiber, g, part, p.activation);
      const Native taut = select(less(broadcast<Native>(0.0), abs(f.pull.stiffness)),
                                 broadcast<Native>(1.0), Native{});
      Jet<Native> l[3];
      Native Zm[3];
      for (int i = 0; i < 3; ++i) {
        Zm[i] = Z[part][3 * i] * m[0] + Z[part][3 * i + 1] * m[1] + Z[part][3 * i + 2] * m[2];
        const Native Dm =
            D[part][3 * i] * m[0] + D[part][3 * i + 1] * m[1] + D[part][3 * i + 2] * m[2];
        l[i] = {f.state.unit[i] * f.state.length, Zm[i], Dm, Native{}};
      }
      const Jet<Native> over = inverse(square_root(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]));
      Native stretched{}, pulled{};  // Z : (P + dP[D]) per unit stiffness, and of l/|l| m^T
      const Native weight = split(shape.weight, part);
      for (int i = 0; i < 3; ++i) {
        const Jet<Native> unit = over * l[i];
        const Jet<Native> scaled{activation * unit.v, activation * unit.a, activation * unit.b,
                                 activation * unit.ab};
        const Jet<Native> force = l[i] - scaled;
        stretched += Zm[i] * (force.v + force.b);
        pulled += Zm[i] * (unit.v + unit.b);
        for (int j = 0; j < 3; ++j) P[part][3 * i + j] = f.pull.stiffness * force.ab * m[j];
      }
      by_stiffness[part] = weight * taut * stretched;
      by_activation[part] = -weight * f.pull.stiffness * pulled;
    }
    Group::add_element_value(fiber, g, by_stiffness, out.fiber_stiffness);
    Group::add_element_value(fiber, g, by_activation, out.activation);
    scatter_stress(shape, P,
                   scratch.vectors.data() + model.fiber_vectors_start + g * fiber.vectors_size());
  });
}

}  // namespace

void linearized_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                        const double* d, const double* z, double* force,
                        const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool) {
  const auto clear = [](double* values, Index size) { std::fill(values, values + size, 0.0); };
  clear(out.w_mu, model.solid.num_elements);
  clear(out.w_vol, model.solid.num_elements);
  clear(out.fiber_stiffness, model.fiber.num_elements);
  clear(out.activation, model.fiber.num_elements);
  scratch.vectors.resize(at(model.vectors_size));
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    solid_adjoint<Group, decltype(material)>(model, p, x, d, z, out, scratch, pool);
    fiber_adjoint<Group>(model, p, x, d, z, out, scratch, pool);
  });
  gather_vectors(model, scratch.vectors.data(), force, pool);
}

}  // namespace diffsim
