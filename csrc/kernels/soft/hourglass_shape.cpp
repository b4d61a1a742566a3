// Derivatives of hourglass forces by the tables of the rest shape, see shape_derivatives.h.
//
// With U = (F, h) of x, Z of z, c(A, B) the bilinear change of the strains at A along B, and W the
// matrix of the weights, the forces do the work W s(U) : c(U, Z), s(U) = c(U, U)/2; those of
// damping W r : c(U_n, Z) with the rate r = c(U_n, U - U_v). c depends on the rows linearly.
// Linearized along D of d, they do W (s(U) + c(U, D)) : c(U, Z) + W s(U) : c(D, Z), and damping has
// U + D.
#include "kernels/soft/hourglass.h"
#include "kernels/soft/hourglass_strains.h"

namespace diffsim::hourglass {
namespace {

using TableRows = Native[kHourglassRows][3];
constexpr int kGamma = TableLanes<Group>::kHourglass, kRow = kGamma + 8 * kHourglassModes;

/// Adds t . dc(A, B)/d(rows).
void add_rows(const Numbers& A, const Numbers& B, const Strains& t, TableRows& out) {
  for (int r = 0; r < kHourglassRows; ++r) {
    const Native *ha = A.h + 3 * mode_of(r), *hb = B.h + 3 * mode_of(r);
    for (int j = 0; j < 3; ++j) {
      Native sum{};
      for (int i = 0; i < 3; ++i) sum += A.F[3 * i + j] * hb[i] + B.F[3 * i + j] * ha[i];
      out[r][j] += t[strain_of(r)] * sum;
    }
  }
}

/// Nodal vectors, and the derivative of the work by their state.
struct StateAlong {
  Lane node[8][3];
  Numbers by[kParts] = {};

  StateAlong(const SoftModel& model, Index g, const double* values) {
    Group::gather(model.solid, g, values, node);
  }
  void add_to_tables(const TableLanes<Group>& lanes, double* tables, Index g) const {
    for (int part = 0; part < kParts; ++part)
      for (int a = 0; a < 8; ++a) {
        Native v[3];
        for (int i = 0; i < 3; ++i) v[i] = split(node[a][i], part);
        const Numbers& f = by[part];
        for (int j = 0; j < 3; ++j)
          lanes.add(tables, g, part, 3 * a + j,
                    f.F[j] * v[0] + f.F[3 + j] * v[1] + f.F[6 + j] * v[2]);
        for (int m = 0; m < kHourglassModes; ++m)
          lanes.add(tables, g, part, kGamma + 8 * m + a,
                    f.h[3 * m] * v[0] + f.h[3 * m + 1] * v[1] + f.h[3 * m + 2] * v[2]);
      }
  }
};

/// How the hourglass shapes of a group move, as lanes.
HourglassShape moved_shape(const TableLanes<Group>& lanes, const double* tables, Index g) {
  HourglassShape shape;
  for (int part = 0; part < kParts; ++part) {
    for (int k = 0; k < 8 * kHourglassModes; ++k)
      join(shape.gamma[k / 8][k % 8], part, lanes.read(tables, g, part, kGamma + k));
    for (int k = 0; k < 3 * kHourglassRows; ++k)
      join(shape.row[k / 3][k % 3], part, lanes.read(tables, g, part, kRow + k));
  }
  return shape;
}

}  // namespace

void add_shape_adjoint(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const double* d, const double* z, double* tables,
                       ThreadPool& pool) {
  const TableLanes<Group> lanes(model.solid);
  const bool is_damped = z && p.damp_mu;
  for_hourglass(model, pool, [&](Index g) {
    const GroupState state(model, g, x), work(model, g, z), moved(model, g, d);
    StateAlong nodes(model, g, x), along(model, g, z ? z : x), linear(model, g, d ? d : x);
    StateAlong frame(model, g, is_damped ? frames.x_frame : x);
    StateAlong velocity(model, g, is_damped ? frames.x_velocity : x);
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part);
      const Numbers &U = state.part[part], &Z = work.part[part], &D = moved.part[part];
      const Native w0 = weight(model, g, part, p.weights, 0);
      const Native w1 = weight(model, g, part, p.weights, 1);
      TableRows by_row = {};
      // Adds t : c(A, B), with the derivatives by A, B and the rows.
      const auto add = [&](const Numbers& A, const Numbers& B, const Strains& t, StateAlong& by_A,
                           StateAlong& by_B) {
        add_forces(rows, B, t, by_A.by[part]);
        add_forces(rows, A, t, by_B.by[part]);
        add_rows(A, B, t, by_row);
      };
      Strains s, t, t_change;
      strains(rows, U.F, U.h, s);
      stresses(s, w0, w1, t);
      if (z) {
        strain_change(rows, U, Z, s);
        stresses(s, w0, w1, t_change);
        add(U, Z, t, nodes, along);
      } else {
        std::copy(t, t + kStrains, t_change);
      }
      if (d) {
        Strains t_moved, t_second;
        strain_change(rows, U, D, s);
        stresses(s, w0, w1, t_moved);
        strain_change(rows, D, Z, s);
        stresses(s, w0, w1, t_second);
        add(U, Z, t_moved, nodes, along);
        add(U, D, t_change, nodes, linear);
        add(D, Z, t, linear, along);
        for (int k = 0; k < kStrains; ++k) t_change[k] += t_second[k];
      }
      add_forces(rows, U, t_change, nodes.by[part]);
      for (Native& half : t_change) half *= 0.5;
      add_rows(U, U, t_change, by_row);
      if (is_damped) {
        const DampingModuli moduli(model, p, g, part);
        const Numbers Un = frame_state(frames, g, part);
        const Numbers delta = minus(plus(U, D), velocity_state(frames, g, part));
        strain_change(rows, Un, delta, s);
        stresses(s, moduli.mu, moduli.plane, t);
        strain_change(rows, Un, Z, s);
        stresses(s, moduli.mu, moduli.plane, t_change);
        add(Un, Z, t, frame, along);
        add(Un, delta, t_change, frame, nodes);
        if (d) add_forces(rows, Un, t_change, linear.by[part]);
        for (Native& negative : t_change) negative = -negative;
        add_forces(rows, Un, t_change, velocity.by[part]);
      }
      for (int k = 0; k < 3 * kHourglassRows; ++k)
        lanes.add(tables, g, part, kRow + k, by_row[k / 3][k % 3]);
    }
    for (const StateAlong* each : {&nodes, &along, &linear, &frame, &velocity})
      each->add_to_tables(lanes, tables, g);
  });
}

void add_shape_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const double* d, const double* tables, double* vectors,
                       ThreadPool& pool) {
  const TableLanes<Group> lanes(model.solid);
  for_hourglass(model, pool, [&](Index g) {
    GroupShape<8> mean;
    for (int part = 0; part < kParts; ++part)
      for (int k = 0; k < 24; ++k)
        join(mean.grad[k / 3][k % 3], part, lanes.read(tables, g, part, k));
    const HourglassShape shape = moved_shape(lanes, tables, g);
    const double* x_frame = p.damp_mu ? frames.x_frame : nullptr;
    const double* x_velocity = p.damp_mu ? frames.x_velocity : nullptr;
    const GroupState state(model, g, x), d_state(model, g, mean, shape, x);
    const GroupState moved(model, g, d), d_moved(model, g, mean, shape, d);
    const GroupState d_frame(model, g, mean, shape, x_frame);
    const GroupState d_velocity(model, g, mean, shape, x_velocity);
    Numbers force[kParts] = {}, d_force[kParts] = {};
    for (int part = 0; part < kParts; ++part) {
      const Rows rows(shape_of(model, g), part), d_rows(shape, part);
      // Adds the forces of t = W s at A, and how they move with A, with s and with the rows.
      const auto add = [&](const Numbers& A, const Numbers& dA, const Strains& s, const Strains& ds,
                           const Native& w0, const Native& w1) {
        Strains t, dt;
        stresses(s, w0, w1, t);
        stresses(ds, w0, w1, dt);
        add_forces(rows, A, t, force[part]);
        add_forces(rows, dA, t, d_force[part]);
        add_forces(rows, A, dt, d_force[part]);
        add_forces(d_rows, A, t, d_force[part]);
      };
      // c(A, B) and how it moves with A, B and the rows.
      const auto change = [&](const Numbers& A, const Numbers& dA, const Numbers& B,
                              const Numbers& dB, Strains& s, Strains& ds) {
        Strains by_B, by_rows;
        strain_change(rows, A, B, s);
        strain_change(rows, dA, B, ds);
        strain_change(rows, A, dB, by_B);
        strain_change(d_rows, A, B, by_rows);
        for (int k = 0; k < kStrains; ++k) ds[k] += by_B[k] + by_rows[k];
      };
      const Numbers &U = state.part[part], &dU = d_state.part[part];
      const Numbers &D = moved.part[part], &dD = d_moved.part[part];
      const Native w0 = weight(model, g, part, p.weights, 0);
      const Native w1 = weight(model, g, part, p.weights, 1);
      Strains s, ds, other;
      strains(rows, U.F, U.h, s);
      strain_change(rows, U, dU, ds);
      strains(d_rows, U.F, U.h, other);
      for (int k = 0; k < kStrains; ++k) ds[k] += other[k];
      add(U, dU, s, ds, w0, w1);
      if (d) {
        add(D, dD, s, ds, w0, w1);
        change(U, dU, D, dD, s, ds);
        add(U, dU, s, ds, w0, w1);
      }
      if (!p.damp_mu) continue;
      const DampingModuli moduli(model, p, g, part);
      const Numbers Un = frame_state(frames, g, part), &dUn = d_frame.part[part];
      const Numbers delta = minus(plus(U, D), velocity_state(frames, g, part));
      const Numbers d_delta = minus(plus(dU, dD), d_velocity.part[part]);
      change(Un, dUn, delta, d_delta, s, ds);
      add(Un, dUn, s, ds, moduli.mu, moduli.plane);
    }
    scatter(model, g, d_force, vectors);
    scatter(mean, shape, force, vectors + g * model.solid.vectors_size());
  });
}

}  // namespace diffsim::hourglass
