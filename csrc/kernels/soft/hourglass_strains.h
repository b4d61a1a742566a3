// What hourglass strains (hourglass.h) are made of, for the kernels of their derivatives.
#pragma once

#include "kernels/soft/element_stage.h"
#include "kernels/soft/hourglass.h"
#include "kernels/soft/jets.h"

namespace diffsim::hourglass {

using namespace elements;
using Group = MeanHexGroup;

constexpr int kStrains = 12, kAmplitudes = 3 * kHourglassModes;
/// Modes h_rd, h_sd of direction d, in the order 01, 02, 12 (and 012, the fourth).
constexpr int kModes[3][2] = {{0, 1}, {0, 2}, {1, 2}};
constexpr int strain_of(int row) { return row < 18 ? row / 2 : row - 9; }
constexpr int mode_of(int row) { return row < 18 ? kModes[row / 6][row % 2] : 3; }

// Numbers and jets times what has no derivative.
DIFFSIM_INLINE Native scaled(const Native& c, const Native& v) { return c * v; }
DIFFSIM_INLINE Jet<Native> scaled(const Native& c, const Jet<Native>& j) {
  return {c * j.v, c * j.a, c * j.b, c * j.ab};
}

/// Rows of one part of a group.
struct Rows {
  Native row[kHourglassRows][3];

  Rows(const HourglassShape& shape, int part) {
    for (int r = 0; r < kHourglassRows; ++r)
      for (int i = 0; i < 3; ++i) row[r][i] = split(shape.row[r][i], part);
  }
};

/// Mean deformation gradient F and amplitudes h_m (3 m + i) of positions or of their directions.
template <class T>
struct State {
  T F[9], h[kAmplitudes];
};
using Numbers = State<Native>;
using Strains = Native[kStrains];

inline const HourglassShape& shape_of(const SoftModel& model, Index g) {
  return model.solid.hourglass[at(model.solid.mean_class[at(g)])];
}

inline void amplitudes(const SoftModel& model, Index g, const HourglassShape& shape,
                       const double* x, Native (*out)[kAmplitudes]) {
  Lane node[8][3];
  Group::gather(model.solid, g, x, node);
  for (int part = 0; part < kParts; ++part)
    for (int m = 0; m < kHourglassModes; ++m)
      for (int i = 0; i < 3; ++i) {
        Native sum = split(shape.gamma[m][0], part) * split(node[0][i], part);
        for (int a = 1; a < 8; ++a) sum += split(shape.gamma[m][a], part) * split(node[a][i], part);
        out[part][3 * m + i] = sum;
      }
}

/// States of all parts at (num_nodes, 3) values; zero for null.
struct GroupState {
  Numbers part[kParts];

  GroupState(const SoftModel& model, Index g, const double* x)
      : GroupState(model, g, Group::shape(model.solid, g), shape_of(model, g), x) {}

  /// By other shapes than those of the group.
  GroupState(const SoftModel& model, Index g, const GroupShape<8>& mean,
             const HourglassShape& shape, const double* x) {
    if (!x) {
      for (Numbers& s : part) s = Numbers{};
      return;
    }
    Native F[kParts][9], h[kParts][kAmplitudes];
    deformation_gradient<Group>(model.solid, g, mean, x, F);
    amplitudes(model, g, shape, x, h);
    for (int k = 0; k < kParts; ++k) {
      std::copy(F[k], F[k] + 9, part[k].F);
      std::copy(h[k], h[k] + kAmplitudes, part[k].h);
    }
  }
};

inline Numbers minus(const Numbers& a, const Numbers& b) {
  Numbers d;
  for (int i = 0; i < 9; ++i) d.F[i] = a.F[i] - b.F[i];
  for (int i = 0; i < kAmplitudes; ++i) d.h[i] = a.h[i] - b.h[i];
  return d;
}

inline Numbers plus(const Numbers& a, const Numbers& b) {
  Numbers sum;
  for (int i = 0; i < 9; ++i) sum.F[i] = a.F[i] + b.F[i];
  for (int i = 0; i < kAmplitudes; ++i) sum.h[i] = a.h[i] + b.h[i];
  return sum;
}

/// s_k = sum of h_m . F row_r, of a deformation gradient and amplitudes.
template <class T>
inline void strains(const Rows& rows, const T F[9], const T h[kAmplitudes], T s[kStrains]) {
  T g[kAmplitudes];  // F^T h_m
  for (int m = 0; m < kHourglassModes; ++m)
    for (int j = 0; j < 3; ++j)
      g[3 * m + j] = F[j] * h[3 * m] + F[3 + j] * h[3 * m + 1] + F[6 + j] * h[3 * m + 2];
  for (int k = 0; k < kStrains; ++k) s[k] = T{};
  for (int r = 0; r < kHourglassRows; ++r)
    for (int j = 0; j < 3; ++j)
      s[strain_of(r)] = s[strain_of(r)] + scaled(rows.row[r][j], g[3 * mode_of(r) + j]);
}

/// Derivative of the strains at `at` along `along`.
inline void strain_change(const Rows& rows, const Numbers& at, const Numbers& along, Strains& s) {
  Strains other;
  strains(rows, at.F, along.h, s);
  strains(rows, along.F, at.h, other);
  for (int k = 0; k < kStrains; ++k) s[k] += other[k];
}

/// The stresses that weight 0 and weight 1 multiply; w0 and w1 are numbers.
template <class T>
inline void stresses(const T s[kStrains], const Native& w0, const Native& w1, T t[kStrains]) {
  for (int k = 0; k < kStrains; ++k) t[k] = scaled(w0, s[k]);
  for (int d = 0; d < 3; ++d) {
    const T trace = scaled(w1, s[3 * d] + s[3 * d + 1]);
    t[3 * d] = t[3 * d] + trace;
    t[3 * d + 1] = t[3 * d + 1] + trace;
  }
}

/// Transpose of strain_change(): adds sum_k t_k ds_k/dF and ds_k/dh at a state.
template <class T>
inline void add_forces(const Rows& rows, const State<T>& at, const T t[kStrains], State<T>& out) {
  T z[kAmplitudes] = {};
  for (int r = 0; r < kHourglassRows; ++r)
    for (int j = 0; j < 3; ++j) {
      T& sum = z[3 * mode_of(r) + j];
      sum = sum + scaled(rows.row[r][j], t[strain_of(r)]);
    }
  for (int m = 0; m < kHourglassModes; ++m)
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j)
        out.F[3 * i + j] = out.F[3 * i + j] + at.h[3 * m + i] * z[3 * m + j];
      out.h[3 * m + i] = out.h[3 * m + i] + at.F[3 * i] * z[3 * m] +
                         at.F[3 * i + 1] * z[3 * m + 1] + at.F[3 * i + 2] * z[3 * m + 2];
    }
}

inline Native dot(const Strains& a, const Strains& b) {
  Native total = a[0] * b[0];
  for (int k = 1; k < kStrains; ++k) total += a[k] * b[k];
  return total;
}
inline Native dot_traces(const Strains& a, const Strains& b) {
  Native total{};
  for (int d = 0; d < 3; ++d) total += (a[3 * d] + a[3 * d + 1]) * (b[3 * d] + b[3 * d + 1]);
  return total;
}

/// Row k of the hourglass weights of a group, in (num_weights, num_elements) values; zero for null.
inline Native weight(const SoftModel& model, Index g, int part, const double* values, Index k) {
  const Index row = model.num_weights - kHourglassWeights + k;
  return values ? Group::part_value(model.solid, g, part, values + row * model.solid.num_elements)
                : Native{};
}

inline void add_weights(const SoftModel& model, Index g,
                        const Native (&v)[kHourglassWeights][kParts], double* out) {
  for (int k = 0; k < kHourglassWeights; ++k)
    Group::add_element_value(
        model.solid, g, v[k],
        out + (model.num_weights - kHourglassWeights + k) * model.solid.num_elements);
}

/// Weights of damping. That of plane stress, d_mu d_lambda/(d_mu + d_lambda), is homogeneous, and
/// d_mu and d_lambda have the ratio of the solid's moduli: so it is linear in both, with the slopes
/// that this ratio gives, and stationary in the ratio.
struct DampingModuli {
  Native mu, plane;
  Native slope_mu, slope_lambda;  // of `plane`

  DampingModuli(const SoftModel& model, const SoftParameters& p, Index g, int part) {
    const Native ratio =
        weight(model, g, part, p.weights, 1) / weight(model, g, part, p.weights, 0);
    slope_mu = ratio * ratio;
    slope_lambda = (1.0 - ratio) * (1.0 - ratio);
    mu = Group::part_value(model.solid, g, part, p.damp_mu);
    plane = along(mu, Group::part_value(model.solid, g, part, p.damp_lambda));
  }
  Native along(const Native& d_mu, const Native& d_lambda) const {
    return slope_mu * d_mu + slope_lambda * d_lambda;
  }
};

/// The frames of a group at a part, as states.
inline Numbers frame_state(const DampingFrames& frames, Index g, int part) {
  Numbers s;
  split_matrix(frames.solid[at(g)].Fn, part, s.F);
  for (int i = 0; i < kAmplitudes; ++i) s.h[i] = split(frames.hourglass[at(g)].hn[i], part);
  return s;
}
inline Numbers velocity_state(const DampingFrames& frames, Index g, int part) {
  Numbers s;
  split_matrix(frames.solid[at(g)].Fv, part, s.F);
  for (int i = 0; i < kAmplitudes; ++i) s.h[i] = split(frames.hourglass[at(g)].hv[i], part);
  return s;
}

/// Adds forces on F and h to the nodes of a group: f_a += P grad N_a + sum_m Q_m gamma_ma.
/// @param[in,out] out  the group's slice of a vectors buffer
inline void scatter(const GroupShape<8>& mean, const HourglassShape& shape,
                    const Numbers (&force)[kParts], double* out) {
  for (int part = 0; part < kParts; ++part) {
    const Numbers& f = force[part];
    for (int a = 0; a < 8; ++a)
      for (int i = 0; i < 3; ++i) {
        double* to = out + (3 * a + i) * kLanes + part * kNativeLanes;
        Native sum = load<Native>(to);
        for (int j = 0; j < 3; ++j) sum += f.F[3 * i + j] * split(mean.grad[a][j], part);
        for (int m = 0; m < kHourglassModes; ++m)
          sum += f.h[3 * m + i] * split(shape.gamma[m][a], part);
        store(to, sum);
      }
  }
}
inline void scatter(const SoftModel& model, Index g, const Numbers (&force)[kParts],
                    double* vectors) {
  scatter(Group::shape(model.solid, g), shape_of(model, g), force,
          vectors + g * model.solid.vectors_size());
}

/// Calls f(g) for the groups of a solid with hourglass strains.
template <typename F>
inline void for_hourglass(const SoftModel& model, ThreadPool& pool, F&& f) {
  if (model.solid.kind == ElementKind::kMeanHex) for_groups(model.solid, pool, f);
}

}  // namespace diffsim::hourglass
