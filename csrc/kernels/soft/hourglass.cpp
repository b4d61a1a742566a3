#include "kernels/soft/hourglass.h"

#include "kernels/soft/hourglass_strains.h"

namespace diffsim::hourglass {
namespace {

/// What a node's positions move: components c of one axis, three of F and four of h.
constexpr int kColumns = 3 + kHourglassModes;
/// Second derivatives by (component c of axis i, component d of axis k), for the pairs i <= k of
/// kComponents.
using Curvature = Native[6][kColumns][kColumns];

/// Columns that the strains of a direction touch, then those of mode 012.
constexpr int kTouched[4][5] = {{0, 1, 2, 3, 4}, {0, 1, 2, 3, 5}, {0, 1, 2, 4, 5}, {0, 1, 2, 6, 6}};

/// Adds w u u^T; u[i][c] of the listed columns.
template <int kDirection>
DIFFSIM_INLINE void add_square(const Native& w, const Native (*u)[kColumns], Curvature& M) {
  constexpr int count = kDirection < 3 ? 5 : 4;
  for (int pair = 0; pair < 6; ++pair) {
    const int i = kComponents[pair][0], k = kComponents[pair][1];
#pragma GCC unroll 5
    for (int c = 0; c < count; ++c) {
      const Native wu = w * u[i][kTouched[kDirection][c]];
#pragma GCC unroll 5
      for (int d = 0; d < count; ++d)
        M[pair][kTouched[kDirection][c]][kTouched[kDirection][d]] +=
            wu * u[k][kTouched[kDirection][d]];
    }
  }
}

/// Adds (ds/dy)^T W ds/dy at a state, W the matrix of the weights.
template <int kDirection>
DIFFSIM_INLINE void add_direction(const Rows& rows, const Numbers& at, const Native& w0,
                                  const Native& w1, Curvature& M) {
  constexpr int first = kDirection < 3 ? 3 * kDirection : 9;
  Native u[3][3][kColumns] = {};
#pragma GCC unroll 21
  for (int r = 0; r < kHourglassRows; ++r) {
    const int k = strain_of(r) - first, m = mode_of(r);
    if (k < 0 || k > 2) continue;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) {
        u[k][i][j] += at.h[3 * m + i] * rows.row[r][j];
        u[k][i][3 + m] += at.F[3 * i + j] * rows.row[r][j];
      }
    }
  }
  for (int k = 0; k < 3; ++k) add_square<kDirection>(w0, u[k], M);
  if (kDirection == 3) return;
  for (int i = 0; i < 3; ++i)
    for (int c = 0; c < kColumns; ++c) u[0][i][c] += u[1][i][c];
  add_square<kDirection>(w1, u[0], M);
}

void add_squares(const Rows& rows, const Numbers& at, const Native& w0, const Native& w1,
                 Curvature& M) {
  add_direction<0>(rows, at, w0, w1, M);
  add_direction<1>(rows, at, w0, w1, M);
  add_direction<2>(rows, at, w0, w1, M);
  add_direction<3>(rows, at, w0, w1, M);
}

/// Adds sum_k t_k d^2 s_k: between h_m and F, on each axis alone.
void add_bends(const Rows& rows, const Strains& t, Curvature& M) {
  Native z[kHourglassModes][3] = {};
  for (int r = 0; r < kHourglassRows; ++r)
    for (int j = 0; j < 3; ++j) z[mode_of(r)][j] += rows.row[r][j] * t[strain_of(r)];
  for (const int pair : {kComponentPair[0][0], kComponentPair[1][1], kComponentPair[2][2]})
    for (int m = 0; m < kHourglassModes; ++m)
      for (int j = 0; j < 3; ++j) {
        M[pair][j][3 + m] += z[m][j];
        M[pair][3 + m][j] += z[m][j];
      }
}

/// Node blocks of one part: out as in element_matrix.h, at the part.
void multiply_nodes(const Native (*B)[kColumns], const Curvature& M, double* out) {
  for (int pair = 0; pair < 6; ++pair) {
    const int i = kComponents[pair][0], k = kComponents[pair][1];
    for (int b = 0; b < 8; ++b) {
      Native column[kColumns];
      for (int c = 0; c < kColumns; ++c) {
        column[c] = M[pair][c][0] * B[b][0];
        for (int d = 1; d < kColumns; ++d) column[c] += M[pair][c][d] * B[b][d];
      }
      for (int a = 0; a < (i == k ? b + 1 : 8); ++a) {
        Native sum = B[a][0] * column[0];
        for (int c = 1; c < kColumns; ++c) sum += B[a][c] * column[c];
        const int low = a < b ? a : b, high = a < b ? b : a;
        double* block = out + 9 * (high * (high + 1) / 2 + low) * kLanes;
        if (a <= b) store(block + (3 * i + k) * kLanes, sum);
        if (b <= a || i == k) store(block + (3 * k + i) * kLanes, sum);
      }
    }
  }
}

/// Jets of states: positions, and two directions in which they move.
State<Jet<Native>> state_jets(const Numbers& x, const Numbers& first, const Numbers& second) {
  State<Jet<Native>> jets;
  for (int i = 0; i < 9; ++i) jets.F[i] = {x.F[i], first.F[i], second.F[i], Native{}};
  for (int i = 0; i < kAmplitudes; ++i) jets.h[i] = {x.h[i], first.h[i], second.h[i], Native{}};
  return jets;
}

/// Forces that each weight multiplies, as jets.
struct ForceJets {
  State<Jet<Native>> by[kHourglassWeights];

  ForceJets(const Rows& rows, const State<Jet<Native>>& at) : by{} {
    Jet<Native> s[kStrains], t[kStrains];
    strains(rows, at.F, at.h, s);
    const Native one = broadcast<Native>(1.0);
    for (int k = 0; k < kHourglassWeights; ++k) {
      stresses(s, k == 0 ? one : Native{}, k == 1 ? one : Native{}, t);
      add_forces(rows, at, t, by[k]);
    }
  }
};

/// Calls use(entry of the force, jet of weight 0, jet of weight 1) for all entries of F and h.
template <typename Use>
void for_entries(const ForceJets& jets, Numbers& out, Use&& use) {
  for (int i = 0; i < 9; ++i) out.F[i] = use(i, jets.by[0].F[i], jets.by[1].F[i]);
  for (int i = 0; i < kAmplitudes; ++i) out.h[i] = use(9 + i, jets.by[0].h[i], jets.by[1].h[i]);
}

}  // namespace

void fill_frames(const SoftModel& model, const double* x_frame, const double* x_velocity,
                 DampingFrames& frames, ThreadPool& pool) {
  if (model.solid.kind != ElementKind::kMeanHex) return;
  frames.hourglass.resize(at(model.solid.num_groups));
  for_hourglass(model, pool, [&](Index g) {
    HourglassFrame& frame = frames.hourglass[at(g)];
    Native hn[kParts][kAmplitudes], hv[kParts][kAmplitudes];
    amplitudes(model, g, shape_of(model, g), x_frame, hn);
    amplitudes(model, g, shape_of(model, g), x_velocity, hv);
    for (int part = 0; part < kParts; ++part)
      for (int i = 0; i < kAmplitudes; ++i) {
        join(frame.hn[i], part, hn[part][i]);
        join(frame.hv[i], part, hv[part][i]);
      }
  });
}

double add_gradient(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                    const double* x, ElasticityScratch& scratch, ThreadPool& pool) {
  if (model.solid.kind != ElementKind::kMeanHex) return 0.0;
  scratch.partial.assign(at(model.solid.num_groups), 0.0);
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x);
    Numbers force[kParts] = {};
    Native energy[kParts];
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part);
      const Numbers& now = state.part[part];
      Strains s, t;
      strains(rows, now.F, now.h, s);
      stresses(s, weight(model, g, part, p.weights, 0), weight(model, g, part, p.weights, 1), t);
      energy[part] = 0.5 * dot(s, t);
      add_forces(rows, now, t, force[part]);
      if (!p.damp_mu) continue;
      const Numbers frame = frame_state(frames, g, part);
      const DampingModuli moduli(model, p, g, part);
      strain_change(rows, frame, minus(now, velocity_state(frames, g, part)), s);
      stresses(s, moduli.mu, moduli.plane, t);
      energy[part] += 0.5 * dot(s, t);
      add_forces(rows, frame, t, force[part]);
    }
    scatter(model, g, force, scratch.vectors.data());
    scratch.partial[at(g)] = sum(fold(energy));
  });
  double energy = 0.0;
  for (double e : scratch.partial) energy += e;
  return energy;
}

void element_matrix(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                    const double* x, bool clamp, std::int64_t g, const GroupTangent& stress,
                    double* out) {
  const auto& mean = Group::shape(model.solid, g);
  const HourglassShape& shape = shape_of(model, g);
  const GroupState state(model, g, x);
  for (int part = 0; part < kParts; ++part) {
    const Rows rows(shape, part);
    const Numbers& now = state.part[part];
    const Native w0 = weight(model, g, part, p.weights, 0);
    const Native w1 = weight(model, g, part, p.weights, 1);
    Curvature M = {};
    add_squares(rows, now, w0, w1, M);
    if (!clamp) {  // what is left then is positive semidefinite
      Strains s, t;
      strains(rows, now.F, now.h, s);
      stresses(s, w0, w1, t);
      add_bends(rows, t, M);
    }
    if (p.damp_mu) {
      const DampingModuli moduli(model, p, g, part);
      add_squares(rows, frame_state(frames, g, part), moduli.mu, moduli.plane, M);
    }
    const Native volume = split(mean.weight, part);
    for (int pair = 0; pair < 6; ++pair)
      for (int j = 0; j < 3; ++j)
        for (int l = 0; l < 3; ++l) {
          const int row = 3 * kComponents[pair][0] + j, col = 3 * kComponents[pair][1] + l;
          M[pair][j][l] += volume * stress.H[part][row <= col ? 9 * row + col : 9 * col + row];
        }
    Native B[8][kColumns];
    for (int a = 0; a < 8; ++a) {
      for (int j = 0; j < 3; ++j) B[a][j] = split(mean.grad[a][j], part);
      for (int m = 0; m < kHourglassModes; ++m) B[a][3 + m] = split(shape.gamma[m][a], part);
    }
    multiply_nodes(B, M, out + part * kNativeLanes);
  }
}

void add_product(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                 const double* x, const double* z, double* vectors, ThreadPool& pool) {
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x), along(model, g, z);
    Numbers force[kParts] = {};
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part);
      const Numbers& now = state.part[part];
      const Native w0 = weight(model, g, part, p.weights, 0);
      const Native w1 = weight(model, g, part, p.weights, 1);
      Strains s, t;
      strains(rows, now.F, now.h, s);
      stresses(s, w0, w1, t);
      add_forces(rows, along.part[part], t, force[part]);
      strain_change(rows, now, along.part[part], s);
      stresses(s, w0, w1, t);
      add_forces(rows, now, t, force[part]);
      if (!p.damp_mu) continue;
      const DampingModuli moduli(model, p, g, part);
      const Numbers frame = frame_state(frames, g, part);
      strain_change(rows, frame, along.part[part], s);
      stresses(s, moduli.mu, moduli.plane, t);
      add_forces(rows, frame, t, force[part]);
    }
    scatter(model, g, force, vectors);
  });
}

void add_parameter_adjoint(const SoftModel& model, const double* x, const double* z,
                           double* weights, ThreadPool& pool) {
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x), along(model, g, z);
    Native by_weight[kHourglassWeights][kParts];
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part);
      Strains s, change;
      strains(rows, state.part[part].F, state.part[part].h, s);
      strain_change(rows, state.part[part], along.part[part], change);
      by_weight[0][part] = dot(s, change);
      by_weight[1][part] = dot_traces(s, change);
    }
    add_weights(model, g, by_weight, weights);
  });
}

void add_damping_adjoint(const SoftModel& model, const SoftParameters& p,
                         const DampingFrames& frames, const double* x, const double* z,
                         bool frame_pass, const ParameterAdjoint& out, double* vectors,
                         ThreadPool& pool) {
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x), along(model, g, z);
    Numbers force[kParts] = {};
    Native by_mu[kParts], by_lambda[kParts];
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part);
      const DampingModuli moduli(model, p, g, part);
      const Numbers frame = frame_state(frames, g, part);
      const Numbers delta = minus(state.part[part], velocity_state(frames, g, part));
      Strains rate, change, t_rate, t_change;
      strain_change(rows, frame, delta, rate);
      strain_change(rows, frame, along.part[part], change);
      stresses(rate, moduli.mu, moduli.plane, t_rate);
      stresses(change, moduli.mu, moduli.plane, t_change);
      const Native traces = dot_traces(rate, change);
      by_mu[part] = dot(rate, change) + moduli.slope_mu * traces;
      by_lambda[part] = moduli.slope_lambda * traces;
      if (frame_pass) {
        add_forces(rows, along.part[part], t_rate, force[part]);
        add_forces(rows, delta, t_change, force[part]);
      } else {
        for (Native& t : t_change) t = -t;
        add_forces(rows, frame, t_change, force[part]);
      }
    }
    if (frame_pass) {
      Group::add_element_value(model.solid, g, by_mu, out.damp_mu);
      Group::add_element_value(model.solid, g, by_lambda, out.damp_lambda);
    }
    scatter(model, g, force, vectors);
  });
}

void add_energy_slopes(const SoftModel& model, const double* x, double* weights, ThreadPool& pool) {
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x);
    Native by_weight[kHourglassWeights][kParts];
    for (int part = 0; part < kParts; ++part) {
      Strains s;
      strains(Rows(shape_of(model, g), part), state.part[part].F, state.part[part].h, s);
      by_weight[0][part] = 0.5 * dot(s, s);
      by_weight[1][part] = 0.5 * dot_traces(s, s);
    }
    add_weights(model, g, by_weight, weights);
  });
}

void add_parameter_tangent(const SoftModel& model, const SoftParameters& p,
                           const DampingFrames& frames, const double* x, Index k,
                           const ParameterDirections& d, double* vectors, ThreadPool& pool) {
  const Index size = 3 * model.num_nodes;
  const double* weights = d.weights ? d.weights + k * model.weights_size() : nullptr;
  const double* x_frame = d.x_frame ? d.x_frame + k * size : nullptr;
  const double* x_velocity = d.x_velocity ? d.x_velocity + k * size : nullptr;
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x);
    Numbers force[kParts] = {};
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part);
      const Numbers& now = state.part[part];
      Strains s, t;
      strains(rows, now.F, now.h, s);
      stresses(s, weight(model, g, part, weights, 0), weight(model, g, part, weights, 1), t);
      add_forces(rows, now, t, force[part]);
    }
    if (p.damp_mu) {
      const GroupState d_frame(model, g, x_frame), d_velocity(model, g, x_velocity);
      for (int part = 0; part < kParts; ++part) {
        const Rows rows(shape_of(model, g), part);
        const DampingModuli moduli(model, p, g, part);
        const Numbers frame = frame_state(frames, g, part);
        const Numbers delta = minus(state.part[part], velocity_state(frames, g, part));
        const Native d_mu = direction_value<Group>(model.solid, g, part, d.damp_mu, k);
        const Native d_lambda = direction_value<Group>(model.solid, g, part, d.damp_lambda, k);
        Strains rate, change, moved, t, more;
        strain_change(rows, frame, delta, rate);
        stresses(rate, moduli.mu, moduli.plane, t);
        add_forces(rows, d_frame.part[part], t, force[part]);
        strain_change(rows, d_frame.part[part], delta, change);
        strain_change(rows, frame, d_velocity.part[part], moved);
        for (int n = 0; n < kStrains; ++n) change[n] -= moved[n];
        stresses(rate, d_mu, moduli.along(d_mu, d_lambda), t);
        stresses(change, moduli.mu, moduli.plane, more);
        for (int n = 0; n < kStrains; ++n) t[n] += more[n];
        add_forces(rows, frame, t, force[part]);
      }
    }
    scatter(model, g, force, vectors);
  });
}

void add_linearized_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                            const double* d, const double* z, double* weights, double* vectors,
                            ThreadPool& pool) {
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x), first(model, g, z), second(model, g, d);
    Numbers force[kParts];
    Native by_weight[kHourglassWeights][kParts] = {};
    for (int part = 0; part < kParts; ++part) {
      const ForceJets jets(Rows(shape_of(model, g), part),
                           state_jets(state.part[part], first.part[part], second.part[part]));
      const Native w0 = weight(model, g, part, p.weights, 0);
      const Native w1 = weight(model, g, part, p.weights, 1);
      for_entries(jets, force[part],
                  [&](int i, const Jet<Native>& f0, const Jet<Native>& f1) -> Native {
                    const Native Z = i < 9 ? first.part[part].F[i] : first.part[part].h[i - 9];
                    by_weight[0][part] += Z * (f0.v + f0.b);
                    by_weight[1][part] += Z * (f1.v + f1.b);
                    return w0 * f0.ab + w1 * f1.ab;
                  });
    }
    add_weights(model, g, by_weight, weights);
    scatter(model, g, force, vectors);
  });
}

void add_linearized_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                            const double* d, const double* dx, const ParameterDirections& along,
                            Index k, double* vectors, ThreadPool& pool) {
  const double* moved = along.weights ? along.weights + k * model.weights_size() : nullptr;
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x), first(model, g, dx), second(model, g, d);
    Numbers force[kParts];
    for (int part = 0; part < kParts; ++part) {
      const ForceJets jets(Rows(shape_of(model, g), part),
                           state_jets(state.part[part], first.part[part], second.part[part]));
      Native w[2], dw[2];
      for (int n = 0; n < 2; ++n) {
        w[n] = weight(model, g, part, p.weights, n);
        dw[n] = weight(model, g, part, moved, n);
      }
      for_entries(
          jets, force[part], [&](int, const Jet<Native>& f0, const Jet<Native>& f1) -> Native {
            return w[0] * f0.ab + w[1] * f1.ab + dw[0] * (f0.v + f0.b) + dw[1] * (f1.v + f1.b);
          });
    }
    scatter(model, g, force, vectors);
  });
}

void scalar_matrix(const HourglassShape& shape, Lane out[8][8]) {
  Lane stiffness[kHourglassModes] = {};  // mean over the three axes at rest
  for (int r = 0; r < kHourglassRows; ++r)
    for (int j = 0; j < 3; ++j)
      stiffness[mode_of(r)] += (1.0 / 3.0) * shape.row[r][j] * shape.row[r][j];
  for (int a = 0; a < 8; ++a)
    for (int b = 0; b < 8; ++b) {
      out[a][b] = Lane{};
      for (int m = 0; m < kHourglassModes; ++m)
        out[a][b] += stiffness[m] * shape.gamma[m][a] * shape.gamma[m][b];
    }
}

}  // namespace diffsim::hourglass
