#include "kernels/soft/elasticity.h"

#include "kernels/soft/damping.h"
#include "kernels/soft/element_stage.h"
#include "kernels/soft/hourglass.h"

namespace diffsim {
namespace {

using namespace elements;

/// Whether a material knows its stress without samples.
template <typename M>
constexpr bool kHasStressAlone = std::is_same_v<M, PdMaterial>;

/// Stress [Pa] of a register of a stage; returns its energy density [J/m^3].
template <typename Group, typename M>
Native stress_of(const Stage<Group, M>& stage, int r, const Weights<M>& w, bool by_samples,
                 Native P[9]) {
  if constexpr (kHasStressAlone<M>)
    if (!by_samples) return M::stress_alone(stage.F[r], w.data(), P);
  return stress<M>(stage.sample(r), w.data(), P);
}

template <typename Group, typename M>
void solid_gradient(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                    const double* x, ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const bool by_samples = !(kHasStressAlone<M> && scratch.stresses_alone);
  KeptSamples<M> kept;
  if (by_samples) kept = kept_samples<M>(scratch, model, x);
  kept.is_needed = by_samples;
  for_stages(solid, pool, [&](Index first, int count) {
    const Stage<Group, M> stage(solid, first, count, x, kept, p.damp_mu != nullptr);
    for (int n = 0; n < count; ++n) {
      const Index g = first + n;
      const auto& shape = Group::shape(solid, g);
      Native P[kParts][9], energy[kParts];
      for (int part = 0; part < kParts; ++part) {
        const int r = n * kParts + part;
        const auto w = weights_at<Group, M>(solid, g, part, p.weights);
        Native psi = stress_of<Group, M>(stage, r, w, by_samples, P[part]);
        if (p.damp_mu) {
          Native Fn[9], delta[9];
          split_matrix(frames.solid[at(g)].Fn, part, Fn);
          split_matrix(frames.solid[at(g)].Fv, part, delta);
          for (int i = 0; i < 9; ++i) delta[i] = stage.F[r][i] - delta[i];
          psi += add_viscous_stress(Fn, delta, Group::part_value(solid, g, part, p.damp_mu),
                                    Group::part_value(solid, g, part, p.damp_lambda), P[part]);
        }
        energy[part] = split(shape.weight, part) * psi;
      }
      scatter_stress(Group{}, shape, P, scratch.vectors.data() + g * solid.vectors_size());
      scratch.partial[at(g)] = sum(fold(energy));
    }
  });
}

template <typename Group>
void fiber_gradient(const SoftModel& model, const SoftParameters& p, const double* x,
                    ElasticityScratch& scratch, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  for_groups(fiber, pool, [&](Index g) {
    const auto& shape = Group::shape(fiber, g);
    Native F[kParts][9], P[kParts][9], energy[kParts];
    deformation_gradient<Group>(fiber, g, x, F);
    for (int part = 0; part < kParts; ++part) {
      const FiberPart f = fiber_part<Group>(model, p, g, part, F[part]);
      energy[part] = split(shape.weight, part) * fiber_stress(f.state, f.pull, P[part]);
    }
    scatter_stress(Group{}, shape, P,
                   scratch.vectors.data() + model.fiber_vectors_start + g * fiber.vectors_size());
    scratch.partial[at(model.solid.num_groups + g)] = sum(fold(energy));
  });
}

}  // namespace

DampingFrames damping_frames(const SoftModel& model, const double* x_frame,
                             const double* x_velocity, ThreadPool& pool) {
  DampingFrames frames;
  frames.x_frame = x_frame;
  frames.x_velocity = x_velocity;
  frames.solid.resize(at(model.solid.num_groups));
  const auto fill = [&](auto group) {
    using Group = decltype(group);
    const auto one = [&](Index g, const double* x, Lane out[9]) {
      Native F[kParts][9];
      deformation_gradient<Group>(model.solid, g, x, F);
      for (int part = 0; part < kParts; ++part)
        for (int i = 0; i < 9; ++i) join(out[i], part, F[part][i]);
    };
    for_groups(model.solid, pool, [&](Index g) {
      one(g, x_frame, frames.solid[at(g)].Fn);
      one(g, x_velocity, frames.solid[at(g)].Fv);
    });
  };
  with_group(model.solid, fill);
  hourglass::fill_frames(model, x_frame, x_velocity, frames, pool);
  return frames;
}

double energy_gradient(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, double* gradient, ElasticityScratch& scratch,
                       ThreadPool& pool) {
  scratch.vectors.resize(at(model.vectors_size));
  scratch.partial.resize(at(model.solid.num_groups + model.fiber.num_groups));
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    solid_gradient<Group, decltype(material)>(model, p, frames, x, scratch, pool);
    fiber_gradient<Group>(model, p, x, scratch, pool);
  });
  double energy = 0.0;
  for (double e : scratch.partial) energy += e;
  energy += hourglass::add_gradient(model, p, frames, x, scratch, pool);
  gather_vectors(model, scratch.vectors.data(), gradient, pool);
  return energy;
}

std::int64_t count_inverted(const SoftModel& model, const double* x) {
  std::vector<double> bad(at(model.solid.num_elements), 0.0);
  const auto count = [&](auto group) {
    using Group = decltype(group);
    for (Index g = 0; g < model.solid.num_groups; ++g) {
      Native F[kParts][9], inverted[kParts];
      deformation_gradient<Group>(model.solid, g, x, F);
      for (int part = 0; part < kParts; ++part) {
        const Native* f = F[part];
        const Native det = f[0] * (f[4] * f[8] - f[5] * f[7]) + f[1] * (f[5] * f[6] - f[3] * f[8]) +
                           f[2] * (f[3] * f[7] - f[4] * f[6]);
        inverted[part] = select(less(broadcast<Native>(0.0), det), broadcast<Native>(0.0),
                                broadcast<Native>(1.0));
      }
      Group::add_element_value(model.solid, g, inverted, bad.data());
    }
  };
  with_group(model.solid, count);
  return std::count_if(bad.begin(), bad.end(), [](double n) { return n > 0.0; });
}

}  // namespace diffsim
