#include "kernels/soft/elastic_second.h"

#include "kernels/soft/damping.h"
#include "kernels/soft/elastic_jets.h"
#include "kernels/soft/hourglass.h"
#include "kernels/soft/shape_derivatives.h"

namespace diffsim {
namespace {

using namespace elements;

/// Calls use(group, jets of its parts, their stresses to fill), stresses in principal frames, and
/// leaves what these do to nodes in the vectors buffer.
template <typename Group, typename Use>
void for_solid_jets(const SoftModel& model, const SolidLaw& law, const double* x,
                    const double* first, const double* second, ElasticityScratch& scratch,
                    ThreadPool& pool, Use&& use) {
  const ElementBlock& solid = model.solid;
  for_stages(solid, pool, [&](Index begin, int count) {
    const LawStage<Group> stage(law, solid, begin, count, x, false);
    for (int n = 0; n < count; ++n) {
      const Index g = begin + n;
      Native A[kParts][9], B[kParts][9], stress[kParts][9], P[kParts][9];
      deformation_gradient<Group>(solid, g, first, A);
      deformation_gradient<Group>(solid, g, second, B);
      SolidJets jets[kParts];
      for (int part = 0; part < kParts; ++part)
        law.jets(stage.sample(n * kParts + part), A[part], B[part], jets[part]);
      use(g, jets, stress);
      for (int part = 0; part < kParts; ++part) jets[part].out_of_frame(stress[part], P[part]);
      scatter_stress(Group{}, Group::shape(solid, g), P,
                     scratch.vectors.data() + g * solid.vectors_size());
    }
  });
}

/// Z : (P + dP[D]) of a law of unit weight, and its d^2P[Z, D] added with a weight.
Native take(const Jet<Native> P[9], const Native Z[9], const Native& weight, Native mixed[9]) {
  Native total = broadcast<Native>(0.0);
  for (int i = 0; i < 9; ++i) {
    total += Z[i] * (P[i].v + P[i].b);
    mixed[i] += weight * P[i].ab;
  }
  return total;
}

template <typename Group>
void solid_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* z, const ParameterAdjoint& out,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const SolidLaw law(model, x, &scratch);
  for_solid_jets<Group>(model, law, x, z, d, scratch, pool,
                        [&](Index g, const SolidJets(&jets)[kParts], Native(&stress)[kParts][9]) {
                          Native by_weight[kMostWeights][kParts];
                          for (int part = 0; part < kParts; ++part) {
                            const SolidJets& own = jets[part];
                            const LawWeights w = law.weights_at<Group>(solid, g, part, p.weights);
                            const Native weight = split(Group::shape(solid, g).weight, part);
                            std::fill(stress[part], stress[part] + 9, Native{});
                            for (int k = 0; k < law.num_weights; ++k)
                              by_weight[k][part] =
                                  weight * take(own.P[k], own.first, w[at(k)], stress[part]);
                          }
                          law.add_weights<Group>(solid, g, by_weight, out.weights);
                        });
}

template <typename Group>
void solid_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* dx, const ParameterDirections& along, Index k,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const SolidLaw law(model, x, &scratch);
  for_solid_jets<Group>(model, law, x, dx, d, scratch, pool,
                        [&](Index g, const SolidJets(&jets)[kParts], Native(&stress)[kParts][9]) {
                          for (int part = 0; part < kParts; ++part) {
                            const auto& P = jets[part].P;
                            const LawWeights w = law.weights_at<Group>(solid, g, part, p.weights);
                            const LawWeights dw =
                                law.weights_along<Group>(model, g, part, along.weights, k);
                            for (int i = 0; i < 9; ++i) {
                              Native total = w[0] * P[0][i].ab + w[1] * P[1][i].ab;
                              for (int m = 2; m < law.num_weights; ++m)
                                total += w[at(m)] * P[m][i].ab;
                              for (int m = 0; m < law.num_weights; ++m)
                                total += dw[at(m)] * (P[m][i].v + P[m][i].b);
                              stress[part][i] = total;
                            }
                          }
                        });
}

/// As for_solid_jets; stresses are `pull` times the fiber's direction.
template <typename Group, typename Use>
void for_fiber_jets(const SoftModel& model, const SoftParameters& p, const double* x,
                    const double* first, const double* second, ElasticityScratch& scratch,
                    ThreadPool& pool, Use&& use) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    Native F[kParts][9], A[kParts][9], B[kParts][9], P[kParts][9], pull[kParts][3];
    deformation_gradient<Group>(fiber, g, x, F);
    deformation_gradient<Group>(fiber, g, first, A);
    deformation_gradient<Group>(fiber, g, second, B);
    FiberJets jets[kParts];
    for (int part = 0; part < kParts; ++part)
      jets[part].fill<Group>(model, p, g, part, F[part], A[part], B[part]);
    use(g, jets, pull);
    for (int part = 0; part < kParts; ++part)
      for (int i = 0; i < 9; ++i) P[part][i] = pull[part][i / 3] * jets[part].direction[i % 3];
    scatter_stress(Group{}, Group::shape(fiber, g), P,
                   scratch.vectors.data() + model.fiber_vectors_start + g * fiber.vectors_size());
  });
}

template <typename Group>
void fiber_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* z, const ParameterAdjoint& out,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_fiber_jets<Group>(model, p, x, z, d, scratch, pool,
                        [&](Index g, const FiberJets(&jets)[kParts], Native(&pull)[kParts][3]) {
                          Native by_stiffness[kParts], by_activation[kParts];
                          for (int part = 0; part < kParts; ++part) {
                            const FiberJets& own = jets[part];
                            // Z : (P + dP[D]) per unit stiffness, and of l/|l| m^T
                            Native stretched{}, turned{};
                            for (int i = 0; i < 3; ++i) {
                              stretched += own.first[i] * (own.pulled[i].v + own.pulled[i].b);
                              turned += own.first[i] * (own.unit[i].v + own.unit[i].b);
                              pull[part][i] = own.stiffness * own.pulled[i].ab;
                            }
                            const Native weight = split(Group::shape(fiber, g).weight, part);
                            by_stiffness[part] = weight * own.taut * stretched;
                            by_activation[part] = -weight * own.stiffness * turned;
                          }
                          Group::add_element_value(fiber, g, by_stiffness, out.fiber_stiffness);
                          Group::add_element_value(fiber, g, by_activation, out.activation);
                        });
}

template <typename Group>
void fiber_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* dx, const ParameterDirections& along, Index k,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_fiber_jets<Group>(
      model, p, x, dx, d, scratch, pool,
      [&](Index g, const FiberJets(&jets)[kParts], Native(&pull)[kParts][3]) {
        for (int part = 0; part < kParts; ++part) {
          const FiberJets& own = jets[part];
          const Native by_stiffness =
              own.taut * direction_value<Group>(fiber, g, part, along.fiber_stiffness, k);
          const Native by_activation =
              own.stiffness * direction_value<Group>(fiber, g, part, along.activation, k);
          for (int i = 0; i < 3; ++i)
            pull[part][i] = own.stiffness * own.pulled[i].ab +
                            by_stiffness * (own.pulled[i].v + own.pulled[i].b) -
                            by_activation * (own.unit[i].v + own.unit[i].b);
        }
      });
}

}  // namespace

void linearized_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                        const double* d, const double* z, double* force,
                        const ParameterAdjoint& out, ElasticityScratch& scratch, ThreadPool& pool) {
  const auto clear = [](double* values, Index size) { std::fill(values, values + size, 0.0); };
  clear(out.weights, model.weights_size());
  clear(out.fiber_stiffness, model.fiber.num_elements);
  clear(out.activation, model.fiber.num_elements);
  scratch.vectors.resize(at(model.vectors_size));
  with_group(model.solid, [&](auto group) {
    using Group = decltype(group);
    solid_adjoint<Group>(model, p, x, d, z, out, scratch, pool);
    fiber_adjoint<Group>(model, p, x, d, z, out, scratch, pool);
  });
  hourglass::add_linearized_adjoint(model, p, x, d, z, out.weights, scratch.vectors.data(), pool);
  gather_vectors(model, scratch.vectors.data(), force, pool);
}

void linearized_tangent(const SoftModel& model, const SoftParameters& p,
                        const DampingFrames& frames, const double* x, const double* d,
                        const double* dx, const ParameterDirections& along, Index k, double* force,
                        ElasticityScratch& scratch, ThreadPool& pool) {
  scratch.vectors.resize(at(model.vectors_size));
  with_group(model.solid, [&](auto group) {
    using Group = decltype(group);
    solid_tangent<Group>(model, p, x, d, dx, along, k, scratch, pool);
    fiber_tangent<Group>(model, p, x, d, dx, along, k, scratch, pool);
  });
  hourglass::add_linearized_tangent(model, p, x, d, dx, along, k, scratch.vectors.data(), pool);
  add_shape_tangent(model, p, frames, x, d, k, along, scratch.vectors.data(), pool);
  gather_vectors(model, scratch.vectors.data(), force, pool);
}

}  // namespace diffsim
