// The solid's law at a sample, whatever the material: for derivatives that are asked for seldom,
// those of second order, by shape, and of energies.
//
// Made for every pair of a material and a kind of element, they took a tenth of the time in which
// all kernels are compiled. Here a law is called through a pointer, hundreds of instructions at a
// time. Forces and their tangents stay with Stage<Group, M>: through pointers they took up to a
// quarter longer.
#pragma once

#include <array>
#include <cstddef>

#include "kernels/soft/element_stage.h"
#include "kernels/soft/jets.h"

namespace diffsim::elements {

/// Of any material (material.h), which has two weights at least; solid_law.cpp compares.
inline constexpr int kMostWeights = 3;
inline constexpr std::size_t kLargestSample = 40 * sizeof(Native);

/// A value of each weight of the law, as many as there are.
using LawWeights = std::array<Native, kMostWeights>;

/// The law along two directions of F, in the principal frame of F where its jets are.
struct SolidJets {
  bool is_in_frame;
  PrincipalFrame<Native> frame;    // of those jets
  Native first[9];                 // the first direction
  Jet<Native> P[kMostWeights][9];  // the stress that each weight multiplies

  /// A matrix of the jets' frame as it is in the axes of F.
  void out_of_frame(const Native A[9], Native out[9]) const;
};

/// Stress P of a sample, its tangent dP/dF on and above the diagonal, and psi.
struct SampleLaw {
  Native P[9], H[81] = {}, psi;
};

/// Some samples, one after another, each of SolidLaw::sample_size bytes.
using Samples = unsigned char;

/// A material's functions, and its samples that a scratch keeps.
struct SolidLaw {
  int num_weights;
  std::size_t sample_size;
  Samples* kept = nullptr;  // of KeptSamples
  bool is_ready = false;    // whether they need not be made

  /// Samples of deformation gradients, into memory that holds none.
  void (*make)(const Native (*F)[9], int count, Samples* out);
  /// Energy density [J/m^3], first Piola stress [Pa], and dP/dF on and above the diagonal.
  void (*fill)(const Samples* sample, const LawWeights& weights, SampleLaw& out);
  /// Energies of unit weights, and their stresses.
  void (*unit_energies)(const Samples* sample, Native* psi);
  void (*unit_stresses)(const Samples* sample, Native (*P)[9]);
  void (*jets)(const Samples* sample, const Native A[9], const Native B[9], SolidJets& out);

  /// The law of a model; with the samples kept at x where there is a scratch that keeps them.
  explicit SolidLaw(const SoftModel& model, const double* x = nullptr,
                    ElasticityScratch* scratch = nullptr);

  /// The weights of a (num_weights, num_elements) array at a part of a group.
  template <typename Group>
  LawWeights weights_at(const ElementBlock& solid, Index g, int part, const double* values) const {
    LawWeights w;
    for (int k = 0; k < num_weights; ++k)
      w[at(k)] = Group::part_value(solid, g, part, values + k * solid.num_elements);
    return w;
  }

  /// Item k of a (count, num_weights, num_elements) array at a part of a group; zero for null.
  template <typename Group>
  LawWeights weights_along(const SoftModel& model, Index g, int part, const double* values,
                           Index k) const {
    if (!values) return {};
    return weights_at<Group>(model.solid, g, part, values + k * model.weights_size());
  }

  /// Adds v[weight][part] to a (num_weights, num_elements) array.
  template <typename Group>
  void add_weights(const ElementBlock& solid, Index g, const Native (&v)[kMostWeights][kParts],
                   double* out) const {
    for (int k = 0; k < num_weights; ++k)
      Group::add_element_value(solid, g, v[k], out + k * solid.num_elements);
  }
};

/// As Stage, of a law.
template <typename Group>
class LawStage {
 public:
  Native F[kStageParts][9];  // made unless there are samples and no need

  LawStage(const SolidLaw& law, const ElementBlock& block, Index first, int count, const double* x,
           bool needs_F = true)
      : size_(law.sample_size) {
    if (law.kept) samples_ = law.kept + at(first * kParts) * size_;
    if (needs_F || !law.is_ready)
      for (int n = 0; n < count; ++n)
        deformation_gradient<Group>(block, first + n, x, F + n * kParts);
    if (!law.is_ready) law.make(F, count * kParts, samples_);
  }
  LawStage(const LawStage&) = delete;
  LawStage& operator=(const LawStage&) = delete;

  const Samples* sample(int part) const { return samples_ + at(part) * size_; }

 private:
  alignas(64) Samples own_[kStageParts * kLargestSample];
  std::size_t size_;
  Samples* samples_ = own_;
};

}  // namespace diffsim::elements
