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

#include "kernels/rod/section_duals.h"
#include "kernels/rod/sweep.h"

namespace diffsim::rod {

/// Three columns at a time, of one member or of one in each lane.
template <class T>
struct SlopeTypes {
  using Columns = double __attribute__((vector_size(32)));  // the last lane unused
  using Dual = LaneDual;
};
template <>
struct SlopeTypes<Native> {
  struct Columns {
    Native at[3] = {};

    Native& operator[](int k) { return at[k]; }
    const Native& operator[](int k) const { return at[k]; }
    DIFFSIM_INLINE Columns& operator+=(const Columns& b) {
      for (int k = 0; k < 3; ++k) at[k] += b.at[k];
      return *this;
    }
    DIFFSIM_INLINE friend Columns operator+(Columns a, const Columns& b) { return a += b; }
    DIFFSIM_INLINE friend Columns operator-(const Columns& a, const Columns& b) {
      return {{a.at[0] - b.at[0], a.at[1] - b.at[1], a.at[2] - b.at[2]}};
    }
    DIFFSIM_INLINE friend Columns operator*(const Native& a, const Columns& b) {
      return {{a * b.at[0], a * b.at[1], a * b.at[2]}};
    }
    DIFFSIM_INLINE friend Columns operator*(double a, const Columns& b) {
      return broadcast<Native>(a) * b;
    }
  };
  using Dual = SectionDuals;
};

template <class T>
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
  void find(const Sweep<T>& s, std::int64_t row, std::int64_t column, T* to) {
    std::fill(edges_.begin(), edges_.end(), T{});
    edges_[0] = edges_[4] = edges_[8] = T{} + 1.0;
    for (std::int64_t i = 0; i < s.n; ++i) {
      multiply(&edges_[9 * i], &s.halves[9 * i], &middles_[9 * i]);
      multiply(&middles_[9 * i], &s.halves[9 * i], &edges_[9 * (i + 1)]);
      parts_[i] = part_of(s, i);
    }
    for (std::int64_t j = 0; j < s.n; ++j) find_columns(s, j, row, column, to + 3 * j * column);
  }

 private:
  using Columns = typename SlopeTypes<T>::Columns;
  using Dual = typename SlopeTypes<T>::Dual;
  struct Three {
    Columns row[3] = {};
  };
  /// Derivatives of an element: rows of what is named, by the last word.
  struct Part {
    T stretch_by_u[9], moment_by_u[9];
    T stretch_by_turn[9], moment_by_turn[9], along_by_turn[9];
    T stretch_by_force[9], moment_by_force[9];
    T stretch_by_pull[3], moment_by_pull[3], along_by_pull[3];
    T local_along[3];  ///< Q v
    T local_outer[3];  ///< B' outer
    T turned[3];       ///< R' outer
  };

  static void add_times(const T* A, const Three& B, Three& to) {
    for (int i = 0; i < 3; ++i)
      to.row[i] += A[3 * i] * B.row[0] + A[3 * i + 1] * B.row[1] + A[3 * i + 2] * B.row[2];
  }
  static void add_transposed_times(const T* A, const Three& B, Three& to) {
    for (int i = 0; i < 3; ++i)
      to.row[i] += A[i] * B.row[0] + A[3 + i] * B.row[1] + A[6 + i] * B.row[2];
  }
  static void add_scaled(double scale, const Three& B, Three& to) {
    for (int i = 0; i < 3; ++i) to.row[i] += scale * B.row[i];
  }
  static void add_outer_of(const T* a, const Columns& b, Three& to) {
    for (int i = 0; i < 3; ++i) to.row[i] += a[i] * b;
  }
  /// to += scale a x B
  static void add_crossed(double scale, const T* a, const Three& B, Three& to) {
    const T x = scale * a[0], y = scale * a[1], z = scale * a[2];
    to.row[0] += y * B.row[2] - z * B.row[1];
    to.row[1] += z * B.row[0] - x * B.row[2];
    to.row[2] += x * B.row[1] - y * B.row[0];
  }
  /// [scale a]x as a matrix.
  static void crossing(double scale, const T* a, T* K) {
    K[0] = K[4] = K[8] = T{};
    for (int i = 0; i < 3; ++i) {
      const int next = (i + 1) % 3, last = (i + 2) % 3;
      K[3 * last + next] = scale * a[i];
      K[3 * next + last] = -scale * a[i];
    }
  }

  /// Derivatives of a section by u, force and tension into `part`.
  void differentiate(const Sweep<T>& s, std::int64_t i, Part& part) {
    const std::int64_t num = s.body.num_tendons;
    Dual u[3], force[3], rounds[3 * (kRounds + 1)], moment[3];
    const Section<Dual, T> section{num,
                                   3 * s.n,
                                   T{} + s.body.radius[i],
                                   u,
                                   force,
                                   tension_.data(),
                                   s.section_numbers(s.numbers.data(), i)};
    for (int first = 0; first < kDirections; first += kAtOnce) {
      for (int k = 0; k < 3; ++k) {
        u[k] = constant(s.u[3 * i + k]);
        force[k] = constant(s.local[3 * i + k]);
      }
      for (std::int64_t t = 0; t < num; ++t) tension_[t] = constant(s.tension[i * num + t]);
      const int end = std::min(first + kAtOnce, kDirections);
      for (int d = first; d < end; ++d) {
        const int lane = d - first;
        if (d < 3)
          u[d].along[lane] = T{} + 1.0;
        else if (d < 6)
          force[d - 3].along[lane] = T{} + 1.0;
        else
          for (std::int64_t t = 0; t < num; ++t) tension_[t].along[lane] = tension_[t].value;
      }
      section.solve(rounds, moment);
      for (int d = first; d < end; ++d) {
        const int lane = d - first;
        for (int k = 0; k < 3; ++k) {
          const T v = rounds[3 * kRounds + k].along[lane], m = moment[k].along[lane];
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
  /// Directions that a number takes along at once.
  static constexpr int kAtOnce = std::is_same_v<T, double> ? kNativeLanes : kDirections;
  static Dual constant(const T& value) {
    Dual out;
    out.value = value;
    return out;
  }

  Part part_of(const Sweep<T>& s, std::int64_t i) {
    Part part;
    differentiate(s, i, part);
    const T *Q = &middles_[9 * i], *B = s.field(kBase);
    T there[3] = {}, force[9], local[9], along[9], turned[9];
    add_transposed(B, &s.force[3 * i], there);
    crossing(1.0, there, force);
    for (int k = 0; k < 3; ++k)
      for (int l = 0; l < 3; ++l)
        local[3 * k + l] = Q[k] * force[l] + Q[3 + k] * force[3 + l] + Q[6 + k] * force[6 + l];
    multiply(part.stretch_by_force, local, part.stretch_by_turn);
    multiply(part.moment_by_force, local, part.moment_by_turn);
    for (int k = 0; k < 3; ++k)
      part.along_by_pull[k] = part.turned[k] = part.local_along[k] = part.local_outer[k] = T{};
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
  static Three turning(const T* u, double half, double scale) {
    const T w[3] = {half * u[0], half * u[1], half * u[2]};
    const T square = dot(w, w);
    const TurnTerms<T> t = turn_terms(square);
    const T c = t.b + 2.0 * t.a_slope;
    T K[9];
    crossing(-1.0, w, K);
    Three J;
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)  // K K = w w' - |w|^2 I
        J.row[i][k] =
            scale * (t.b * K[3 * i + k] + c * w[i] * w[k] + (i == k ? 1.0 - c * square : T{}));
    return J;
  }

  void find_columns(const Sweep<T>& s, std::int64_t j, std::int64_t row, std::int64_t column,
                    T* to) {
    const double h = s.length(j);
    const T *Q = &middles_[9 * j], friction = *s.field(kFriction);
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
    const T* weight = s.field(kWeight);
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
              (i >= j ? of_moment_[i].row[r][c] : T{}) - change.row[r][c];
    }
  }

  /// How a point of the element moves whose strains do.
  Three own_place(const Sweep<T>& s, std::int64_t p, const Three& stretch) const {
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
  Three place_beyond(const Sweep<T>& s, std::int64_t p, const Three& node, const Three& turn,
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

  static Three in_world(const Sweep<T>& s, const Three& of_base) {
    Three out;
    add_times(s.field(kBase), of_base, out);
    return out;
  }

  /// Sweep::point_frames in the frame of the base, and what they turn.
  struct Frames {
    Frames(const Slopes& of, const Sweep<T>& s, std::int64_t p) : element(s.body.around[p]) {
      const auto f = s.point_frames(p);
      past = f.past;
      multiply(&of.edges_[9 * element], f.halfway, turned);
      multiply(turned, f.halfway, there);
      add_product(turned, s.stretch(element), axis);
      add_product(there, s.field(kPoints) + 3 * p, arm);
    }
    std::int64_t element;
    double past;
    T turned[9], there[9], axis[3] = {}, arm[3] = {};
  };

  std::vector<Dual> tension_;
  std::vector<T> middles_, edges_;  ///< Q in the middles and at the edges
  std::vector<Part> parts_;
  std::vector<Three> of_along_, of_center_, of_moment_, of_loads_;
};

}  // namespace diffsim::rod
