#include "kernels/soft/elastic_second.h"

#include "kernels/soft/damping.h"
#include "kernels/soft/element_stage.h"

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

/// What one part of a group of the solid gives: its law along two directions, in the principal
/// frame of F where its jets are.
template <typename M>
struct SolidJets {
  Native first[9];                // the first direction
  Jet<Native> P[M::kWeights][9];  // the stress that each weight multiplies
};

/// Calls use(group, jets of its parts, their stresses to fill), stresses in principal frames, and
/// leaves what these do to nodes in the vectors buffer.
template <typename Group, typename M, typename Use>
void for_solid_jets(const SoftModel& model, const double* x, const double* first,
                    const double* second, ElasticityScratch& scratch, ThreadPool& pool, Use&& use) {
  const ElementBlock& solid = model.solid;
  const KeptSamples<M> kept = kept_samples<M>(scratch, model, x);
  for_stages(solid, pool, [&](Index begin, int count) {
    const Stage<Group, M> stage(solid, begin, count, x, kept, false);
    for (int n = 0; n < count; ++n) {
      const Index g = begin + n;
      Native A[kParts][9], B[kParts][9], stress[kParts][9], P[kParts][9];
      PrincipalFrame<Native> frames[kParts];  // of those jets
      deformation_gradient<Group>(solid, g, first, A);
      deformation_gradient<Group>(solid, g, second, B);
      SolidJets<M> jets[kParts];
      for (int part = 0; part < kParts; ++part) {
        const auto& sample = stage.sample(n * kParts + part);
        SolidJets<M>& own = jets[part];
        const auto& source = jet_source<M, Native>(sample);
        Native Bp[9];
        Jet<Native> F[9];
        if constexpr (M::kJetsInFrame) {
          frames[part] = source;
          into_frame(source, A[part], own.first);
          into_frame(source, B[part], Bp);
          for (int i = 0; i < 9; ++i)
            F[i] = {i % 4 == 0 ? source.s[i / 4] : Native{}, own.first[i], Bp[i], Native{}};
        } else {
          for (int i = 0; i < 9; ++i) {
            own.first[i] = A[part][i];
            F[i] = {sample.F[i], A[part][i], B[part][i], Native{}};
          }
        }
        M::jets(source, F, own.P);
      }
      use(g, jets, stress);
      for (int part = 0; part < kParts; ++part) {
        if constexpr (!M::kJetsInFrame) {
          std::copy(stress[part], stress[part] + 9, P[part]);
          continue;
        }
        const PrincipalFrame<Native>& frame = frames[part];
        Native turned[9];
        times(frame.U, stress[part], turned);
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j)
            P[part][3 * i + j] = turned[3 * i] * frame.V[3 * j] +
                                 turned[3 * i + 1] * frame.V[3 * j + 1] +
                                 turned[3 * i + 2] * frame.V[3 * j + 2];
      }
      scatter_stress(Group::shape(solid, g), P, scratch.vectors.data() + g * solid.vectors_size());
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

template <typename Group, typename M>
void solid_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* z, const ParameterAdjoint& out,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  for_solid_jets<Group, M>(
      model, x, z, d, scratch, pool,
      [&](Index g, const SolidJets<M>(&jets)[kParts], Native(&stress)[kParts][9]) {
        Native by_weight[M::kWeights][kParts];
        for (int part = 0; part < kParts; ++part) {
          const SolidJets<M>& own = jets[part];
          const Weights<M> w = weights_at<Group, M>(solid, g, part, p.weights);
          const Native weight = split(Group::shape(solid, g).weight, part);
          std::fill(stress[part], stress[part] + 9, Native{});
          for (int k = 0; k < M::kWeights; ++k)
            by_weight[k][part] = weight * take(own.P[k], own.first, w[k], stress[part]);
        }
        add_weights<Group, M>(solid, g, by_weight, out.weights);
      });
}

template <typename Group, typename M>
void solid_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* dx, const ParameterDirections& along, Index k,
                   ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  for_solid_jets<Group, M>(
      model, x, dx, d, scratch, pool,
      [&](Index g, const SolidJets<M>(&jets)[kParts], Native(&stress)[kParts][9]) {
        for (int part = 0; part < kParts; ++part) {
          const auto& P = jets[part].P;
          const Weights<M> w = weights_at<Group, M>(solid, g, part, p.weights);
          const Weights<M> dw = weights_along<Group, M>(solid, g, part, along.weights, k);
          for (int i = 0; i < 9; ++i) {
            Native total = w[0] * P[0][i].ab;
            for (int m = 1; m < M::kWeights; ++m) total += w[m] * P[m][i].ab;
            for (int m = 0; m < M::kWeights; ++m) total += dw[m] * (P[m][i].v + P[m][i].b);
            stress[part][i] = total;
          }
        }
      });
}

/// What one part of a group of fibers gives, along two directions.
struct FiberJets {
  Native first[3];                 // the first direction of l = F m
  Jet<Native> unit[3], pulled[3];  // l/|l|, and l - activation l/|l|
  Native stiffness, taut;          // of the pull, and one where it pulls
};

/// As for_solid_jets; stresses are `pull` times the fiber's direction.
template <typename Group, typename Use>
void for_fiber_jets(const SoftModel& model, const SoftParameters& p, const double* x,
                    const double* first, const double* second, ElasticityScratch& scratch,
                    ThreadPool& pool, Use&& use) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    Native F[kParts][9], A[kParts][9], B[kParts][9], P[kParts][9], pull[kParts][3];
    Native direction[kParts][3];
    deformation_gradient<Group>(fiber, g, x, F);
    deformation_gradient<Group>(fiber, g, first, A);
    deformation_gradient<Group>(fiber, g, second, B);
    FiberJets jets[kParts];
    for (int part = 0; part < kParts; ++part) {
      const FiberPart f = fiber_part<Group>(model, p, g, part, F[part]);
      const Native* m = f.state.direction;
      const Native activation = Group::part_value(fiber, g, part, p.activation);
      FiberJets& own = jets[part];
      own.stiffness = f.pull.stiffness;
      own.taut = select(less(broadcast<Native>(0.0), abs(f.pull.stiffness)), broadcast<Native>(1.0),
                        Native{});
      Jet<Native> l[3];
      for (int i = 0; i < 3; ++i) {
        own.first[i] =
            A[part][3 * i] * m[0] + A[part][3 * i + 1] * m[1] + A[part][3 * i + 2] * m[2];
        const Native Bm =
            B[part][3 * i] * m[0] + B[part][3 * i + 1] * m[1] + B[part][3 * i + 2] * m[2];
        l[i] = {f.state.unit[i] * f.state.length, own.first[i], Bm, Native{}};
        direction[part][i] = m[i];
      }
      const Jet<Native> over = inverse(square_root(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]));
      for (int i = 0; i < 3; ++i) {
        const Jet<Native> unit = over * l[i];
        const Jet<Native> scaled{activation * unit.v, activation * unit.a, activation * unit.b,
                                 activation * unit.ab};
        own.unit[i] = unit;
        own.pulled[i] = l[i] - scaled;
      }
    }
    use(g, jets, pull);
    for (int part = 0; part < kParts; ++part)
      for (int i = 0; i < 9; ++i) P[part][i] = pull[part][i / 3] * direction[part][i % 3];
    scatter_stress(Group::shape(fiber, g), P,
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
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    solid_adjoint<Group, decltype(material)>(model, p, x, d, z, out, scratch, pool);
    fiber_adjoint<Group>(model, p, x, d, z, out, scratch, pool);
  });
  gather_vectors(model, scratch.vectors.data(), force, pool);
}

void linearized_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                        const double* d, const double* dx, const ParameterDirections& along,
                        Index k, double* force, ElasticityScratch& scratch, ThreadPool& pool) {
  scratch.vectors.resize(at(model.vectors_size));
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    solid_tangent<Group, decltype(material)>(model, p, x, d, dx, along, k, scratch, pool);
    fiber_tangent<Group>(model, p, x, d, dx, along, k, scratch, pool);
  });
  gather_vectors(model, scratch.vectors.data(), force, pool);
}

}  // namespace diffsim
