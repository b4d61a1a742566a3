#include "kernels/soft/solid_law.h"

#include <algorithm>
#include <tuple>

#include "kernels/soft/damping.h"

namespace diffsim::elements {
namespace {

template <typename... M>
constexpr bool are_largest(std::tuple<M...>*) {
  return std::min({M::kWeights...}) == 2 && std::max({M::kWeights...}) == kMostWeights &&
         std::max({sizeof(typename M::template Sample<Native>)...}) == kLargestSample;
}
static_assert(are_largest(static_cast<Materials*>(nullptr)));

/// U^T A V.
void into_frame(const PrincipalFrame<Native>& frame, const Native A[9], Native out[9]) {
  Native AV[9];
  times(A, frame.V, AV);
  transpose_times(frame.U, AV, out);
}

/// What a SolidLaw calls.
template <typename M>
struct LawOf {
  using Sample = typename M::template Sample<Native>;
  static const Sample* of(const Samples* samples) {
    return reinterpret_cast<const Sample*>(samples);
  }

  static void make(const Native (*F)[9], int count, Samples* out) {
    make_samples<M, kStageParts>(F, count, reinterpret_cast<Sample*>(out));
  }

  static void fill(const Samples* sample, const LawWeights& weights, SampleLaw& out) {
    out.psi = stress<M>(*of(sample), weights.data(), out.P);
    stiffness<M>(*of(sample), weights.data(), false, out.H);
  }

  static LawWeights unit(int k) {
    LawWeights w{};
    w[at(k)] = broadcast<Native>(1.0);
    return w;
  }
  static void unit_energies(const Samples* sample, Native* psi) {
    Native P[9];
    for (int k = 0; k < M::kWeights; ++k) psi[k] = M::stress(*of(sample), unit(k).data(), P);
  }
  static void unit_stresses(const Samples* sample, Native (*P)[9]) {
    for (int k = 0; k < M::kWeights; ++k) stress<M>(*of(sample), unit(k).data(), P[k]);
  }

  static void jets(const Samples* sample, const Native A[9], const Native B[9], SolidJets& out) {
    const auto& source = jet_source<M, Native>(*of(sample));
    Jet<Native> F[9];
    out.is_in_frame = M::kJetsInFrame;
    if constexpr (M::kJetsInFrame) {
      Native second[9];
      out.frame = source;
      into_frame(source, A, out.first);
      into_frame(source, B, second);
      for (int i = 0; i < 9; ++i)
        F[i] = {i % 4 == 0 ? source.s[i / 4] : Native{}, out.first[i], second[i], Native{}};
    } else {
      std::copy(A, A + 9, out.first);
      for (int i = 0; i < 9; ++i) F[i] = {source.F[i], A[i], B[i], Native{}};
    }
    M::jets(source, F, out.P);
  }
};

}  // namespace

void SolidJets::out_of_frame(const Native A[9], Native out[9]) const {
  if (!is_in_frame) {
    std::copy(A, A + 9, out);
    return;
  }
  Native UA[9];
  times(frame.U, A, UA);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out[3 * i + j] = UA[3 * i] * frame.V[3 * j] + UA[3 * i + 1] * frame.V[3 * j + 1] +
                       UA[3 * i + 2] * frame.V[3 * j + 2];
}

SolidLaw::SolidLaw(const SoftModel& model, const double* x, ElasticityScratch* scratch) {
  with_material(model.material, [&](auto material) {
    using M = decltype(material);
    using Of = LawOf<M>;
    num_weights = M::kWeights;
    sample_size = sizeof(typename Of::Sample);
    make = Of::make;
    fill = Of::fill;
    unit_energies = Of::unit_energies;
    unit_stresses = Of::unit_stresses;
    jets = Of::jets;
    if (!scratch) return;
    const KeptSamples<M> samples = kept_samples<M>(*scratch, model, x);
    kept = reinterpret_cast<Samples*>(samples.data);
    is_ready = samples.is_ready;
  });
}

}  // namespace diffsim::elements
