// How the residual of a sweep changes with all strains at once.
//
// Strains of element j turn what lies beyond it as a whole, by w, and change how much its tendons
// wrap. So each section needs its derivatives once, by its own strains u, by the force n in its
// frame and by a factor q of its tensions; what lies beyond then follows, for i > j, with d = R v,
//   dn_i = R_i' (F_i x w),  dq_i = -friction dturn_j,
//   dd_i = w x d_i + R_i (dv/dn dn_i + dv/dq dq_i),  dm_i = dm/dn dn_i + dm/dq dq_i.
// In element j itself w is R_j t in the middle and w = R_j t + E_{j+1} t behind it, where t is the
// turn of half of it in its own frame, t = J(h u / 2) h du / 2, J(x) = I - b K + c K K, c = b + 2
// a' with a, b, K of turn.h. The base B has a gradient and may be any matrix: with R = B Q, turns
// are those of Q, and w is in the frame of the base: Q' (B' F x w) and B (w x Q v).
#pragma once

#include "kernels/rod/sweep.h"

namespace diffsim::rod {

class Slopes {
 public:
  explicit Slopes(const Body& body)
      : tension_(body.num_tendons),
        middles_(9 * body.num_elements),
        edges_(9 * (body.num_elements + 1)),
        parts_(body.num_elements),
        of_along_(body.num_elements),
        of_center_(body.num_elements),
        of_moment_(body.num_elements),
        of_loads_(body.num_loads) {}

  /// @param[out] to  (3 N, 3 N) d residual_r / du_c at to[r row + c column]
  void find(const Sweep<double>& s, std::int64_t row, std::int64_t column, double* to) {
    std::fill(edges_.begin(), edges_.end(), 0.0);
    edges_[0] = edges_[4] = edges_[8] = 1.0;
    for (std::int64_t i = 0; i < s.n; ++i) {
      multiply(&edges_[9 * i], &s.halves[9 * i], &middles_[9 * i]);
      multiply(&middles_[9 * i], &s.halves[9 * i], &edges_[9 * (i + 1)]);
      parts_[i] = part_of(s, i);
    }
    for (std::int64_t j = 0; j < s.n; ++j) find_columns(s, j, row, column, to + 3 * j * column);
  }

 private:
  /// Of three directions, the last lane unused.
  using Columns = double __attribute__((vector_size(32)));
  struct Three {
    Columns row[3] = {};
  };
  /// Derivatives of an element: rows of what is named, by the last word.
  struct Part {
    double stretch_by_u[9], moment_by_u[9];
    double stretch_by_turn[9], moment_by_turn[9], along_by_turn[9];
    double stretch_by_force[9], moment_by_force[9];
    double stretch_by_pull[3], moment_by_pull[3], along_by_pull[3];
    double local_along[3];  ///< Q v
    double local_outer[3];  ///< B' outer
    double turned[3];       ///< R' outer
  };

  static void add_times(const double* A, const Three& B, Three& to) {
    for (int i = 0; i < 3; ++i)
      to.row[i] += A[3 * i] * B.row[0] + A[3 * i + 1] * B.row[1] + A[3 * i + 2] * B.row[2];
  }
  static void add_transposed_times(const double* A, const Three& B, Three& to) {
    for (int i = 0; i < 3; ++i)
      to.row[i] += A[i] * B.row[0] + A[3 + i] * B.row[1] + A[6 + i] * B.row[2];
  }
  static void add_scaled(double scale, const Three& B, Three& to) {
    for (int i = 0; i < 3; ++i) to.row[i] += scale * B.row[i];
  }
  static void add_outer_of(const double* a, const Columns& b, Three& to) {
    for (int i = 0; i < 3; ++i) to.row[i] += a[i] * b;
  }
  /// to += scale a x B
  static void add_crossed(double scale, const double* a, const Three& B, Three& to) {
    const double x = scale * a[0], y = scale * a[1], z = scale * a[2];
    to.row[0] += y * B.row[2] - z * B.row[1];
    to.row[1] += z * B.row[0] - x * B.row[2];
    to.row[2] += x * B.row[1] - y * B.row[0];
  }
  /// [scale a]x as a matrix.
  static void crossing(double scale, const double* a, double* K) {
    K[0] = K[4] = K[8] = 0.0;
    for (int i = 0; i < 3; ++i) {
      const int next = (i + 1) % 3, last = (i + 2) % 3;
      K[3 * last + next] = scale * a[i];
      K[3 * next + last] = -scale * a[i];
    }
  }

  /// Derivatives of a section by u, force and tension into `part`.
  void differentiate(const Sweep<double>& s, std::int64_t i, Part& part) {
    constexpr int kDirections = 7;
    const std::int64_t num = s.body.num_tendons;
    LaneDual u[3], force[3], rounds[3 * (kRounds + 1)], moment[3];
    const Section<LaneDual, double> section{num,
                                            3 * s.n,
                                            s.body.radius[i],
                                            u,
                                            force,
                                            tension_.data(),
                                            s.section_numbers(s.numbers.data(), i)};
    for (int first = 0; first < kDirections; first += kNativeLanes) {
      for (int k = 0; k < 3; ++k) u[k] = s.u[3 * i + k], force[k] = s.local[3 * i + k];
      for (std::int64_t t = 0; t < num; ++t) tension_[t] = s.tension[i * num + t];
      const int end = std::min(first + kNativeLanes, kDirections);
      for (int d = first; d < end; ++d) {
        const int lane = d - first;
        if (d < 3)
          u[d].along[lane] = 1.0;
        else if (d < 6)
          force[d - 3].along[lane] = 1.0;
        else
          for (std::int64_t t = 0; t < num; ++t) tension_[t].along[lane] = tension_[t].value;
      }
      section.solve(rounds, moment);
      for (int d = first; d < end; ++d) {
        const int lane = d - first;
        for (int k = 0; k < 3; ++k) {
          const double v = rounds[3 * kRounds + k].along[lane], m = moment[k].along[lane];
          if (d < 3)
            part.stretch_by_u[3 * k + d] = v, part.moment_by_u[3 * k + d] = m;
          else if (d < 6)
            part.stretch_by_force[3 * k + d - 3] = v, part.moment_by_force[3 * k + d - 3] = m;
          else
            part.stretch_by_pull[k] = v, part.moment_by_pull[k] = m;
        }
      }
    }
  }

  Part part_of(const Sweep<double>& s, std::int64_t i) {
    Part part;
    differentiate(s, i, part);
    const double *Q = &middles_[9 * i], *B = s.field(kBase);
    double there[3] = {}, force[9], local[9], along[9], turned[9];
    add_transposed(B, &s.force[3 * i], there);
    crossing(1.0, there, force);
    for (int k = 0; k < 3; ++k)
      for (int l = 0; l < 3; ++l)
        local[3 * k + l] = Q[k] * force[l] + Q[3 + k] * force[3 + l] + Q[6 + k] * force[6 + l];
    multiply(part.stretch_by_force, local, part.stretch_by_turn);
    multiply(part.moment_by_force, local, part.moment_by_turn);
    for (int k = 0; k < 3; ++k)
      part.along_by_pull[k] = part.turned[k] = part.local_along[k] = part.local_outer[k] = 0.0;
    add_product(Q, s.stretch(i), part.local_along);
    crossing(-1.0, part.local_along, along);
    multiply(Q, part.stretch_by_turn, turned);
    for (int k = 0; k < 9; ++k) along[k] += turned[k];
    multiply(B, along, part.along_by_turn);
    add_product(&s.middles[9 * i], part.stretch_by_pull, part.along_by_pull);
    add_transposed(B, &s.outer[3 * i], part.local_outer);
    add_transposed(Q, part.local_outer, part.turned);
    return part;
  }

  /// J(w) scale
  static Three turning(const double* u, double half, double scale) {
    const double w[3] = {half * u[0], half * u[1], half * u[2]};
    const double square = dot(w, w);
    const TurnTerms t = turn_terms(square);
    const double c = t.b + 2.0 * t.a_slope;
    double K[9];
    crossing(-t.b, w, K);
    Three J;
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)  // K K = w w' - |w|^2 I
        J.row[i][k] = scale * (K[3 * i + k] + c * w[i] * w[k] + (i == k ? 1.0 - c * square : 0.0));
    return J;
  }

  void find_columns(const Sweep<double>& s, std::int64_t j, std::int64_t row, std::int64_t column,
                    double* to) {
    const double h = s.length(j), *Q = &middles_[9 * j], friction = *s.field(kFriction);
    const Three own = turning(&s.u[3 * j], 0.5 * h, 0.5 * h);
    Three middle, behind;
    add_times(Q, own, middle);
    behind = middle;
    add_times(&edges_[9 * (j + 1)], own, behind);
    Columns pull{};
    for (int k = 1; k < 3; ++k) pull[k] = -friction * h * h * s.u[3 * j + k] / s.turns[j];
    // along the rod
    Three node, own_stretch;
    {
      const Part& part = parts_[j];
      Three force, &moment = of_moment_[j] = {}, &along = of_along_[j] = {};
      add_crossed(1.0, &s.local[3 * j], own, force);
      for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
          own_stretch.row[i][k] = part.stretch_by_u[3 * i + k];
          moment.row[i][k] = part.moment_by_u[3 * i + k];
        }
      add_times(part.stretch_by_force, force, own_stretch);
      add_times(part.moment_by_force, force, moment);
      add_outer_of(part.stretch_by_pull, 0.5 * pull, own_stretch);
      add_outer_of(part.moment_by_pull, 0.5 * pull, moment);
      Three there;
      add_crossed(-1.0, part.local_along, middle, there);
      add_times(Q, own_stretch, there);
      add_times(s.field(kBase), there, along);
      of_center_[j] = {};
      add_scaled(0.5 * h, along, of_center_[j]);
      add_scaled(h, along, node);
      // the residual has R' outer, of which R turns here
      add_crossed(-1.0, part.turned, own, moment);
    }
    for (std::int64_t p = 0; p < s.body.num_loads; ++p)
      if (s.body.around[p] == j) of_loads_[p] = own_place(s, p, own_stretch);
    for (std::int64_t i = j + 1; i < s.n; ++i) {
      const Part& part = parts_[i];
      Three &moment = of_moment_[i] = {}, &along = of_along_[i] = {};
      add_times(part.along_by_turn, behind, along);
      add_outer_of(part.along_by_pull, pull, along);
      add_times(part.moment_by_turn, behind, moment);
      add_outer_of(part.moment_by_pull, pull, moment);
      for (std::int64_t p = 0; p < s.body.num_loads; ++p)
        if (s.body.around[p] == i) of_loads_[p] = place_beyond(s, p, node, behind, pull);
      of_center_[i] = node;
      add_scaled(0.5 * s.length(i), along, of_center_[i]);
      add_scaled(s.length(i), along, node);
      Three outer;  // outer x w
      add_crossed(-1.0, part.local_outer, behind, outer);
      add_transposed_times(&middles_[9 * i], outer, moment);
    }
    // and back, what its weights and loads do
    Three beyond;
    const double* weight = s.field(kWeight);
    for (std::int64_t i = s.n - 1; i >= 0; --i) {
      Three outer = beyond, change;
      if (i >= j) {
        Three at = of_center_[i];
        add_scaled(0.25 * s.length(i), of_along_[i], at);
        add_crossed(-0.5, weight + 3 * i, at, outer);
        add_crossed(1.0, &s.force[3 * i], of_center_[i], outer);
        add_crossed(-1.0, weight + 3 * i, of_center_[i], beyond);
      }
      for (std::int64_t p = 0; p < s.body.num_loads; ++p)
        if (s.is_beyond(p, i) && s.body.around[p] >= j)
          add_crossed(-1.0, s.field(kLoads) + 3 * p, of_loads_[p], outer);
      add_transposed_times(&s.middles[9 * i], outer, change);
      for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
          to[(3 * i + r) * row + c * column] =
              (i >= j ? of_moment_[i].row[r][c] : 0.0) - change.row[r][c];
    }
  }

  /// How a point of the element moves whose strains do.
  Three own_place(const Sweep<double>& s, std::int64_t p, const Three& stretch) const {
    const Frames f(*this, s, p);
    const Three own = turning(&s.u[3 * f.element], 0.5 * f.past, 0.5 * f.past);
    Three turn, place, moved;
    add_times(f.turned, own, turn);
    add_crossed(-f.past, f.axis, turn, place);
    add_times(f.turned, stretch, moved);
    add_scaled(f.past, moved, place);
    add_times(f.there, own, turn);
    add_crossed(-1.0, f.arm, turn, place);
    return in_world(s, place);
  }

  /// How a point of an element beyond moves.
  Three place_beyond(const Sweep<double>& s, std::int64_t p, const Three& node, const Three& turn,
                     const Columns& pull) const {
    const Frames f(*this, s, p);
    const Part& part = parts_[f.element];
    Three stretch, place, moved;
    add_times(part.stretch_by_turn, turn, stretch);
    add_outer_of(part.stretch_by_pull, pull, stretch);
    add_times(f.turned, stretch, moved);
    add_scaled(f.past, moved, place);
    add_crossed(-f.past, f.axis, turn, place);
    add_crossed(-1.0, f.arm, turn, place);
    place = in_world(s, place);
    add_scaled(1.0, node, place);
    return place;
  }

  static Three in_world(const Sweep<double>& s, const Three& of_base) {
    Three out;
    add_times(s.field(kBase), of_base, out);
    return out;
  }

  /// Sweep::point_frames in the frame of the base, and what they turn.
  struct Frames {
    Frames(const Slopes& of, const Sweep<double>& s, std::int64_t p) : element(s.body.around[p]) {
      const auto f = s.point_frames(p);
      past = f.past;
      multiply(&of.edges_[9 * element], f.halfway, turned);
      multiply(turned, f.halfway, there);
      add_product(turned, s.stretch(element), axis);
      add_product(there, s.field(kPoints) + 3 * p, arm);
    }
    std::int64_t element;
    double past, turned[9], there[9], axis[3] = {}, arm[3] = {};
  };

  std::vector<LaneDual> tension_;
  std::vector<double> middles_, edges_;  ///< Q in the middles and at the edges
  std::vector<Part> parts_;
  std::vector<Three> of_along_, of_center_, of_moment_, of_loads_;
};

}  // namespace diffsim::rod
