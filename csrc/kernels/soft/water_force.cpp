#include "kernels/soft/water_force.h"

#include <algorithm>

#include "kernels/linalg/lanes.h"

namespace diffsim {
namespace {

constexpr int kMostCorners = 4;
constexpr double kPi = 3.14159265358979323846;

/// A number with its derivative along one direction.
struct Dual {
  Native v, d;
};
DIFFSIM_INLINE Dual operator+(const Dual& a, const Dual& b) { return {a.v + b.v, a.d + b.d}; }
DIFFSIM_INLINE Dual operator-(const Dual& a, const Dual& b) { return {a.v - b.v, a.d - b.d}; }
DIFFSIM_INLINE Dual operator*(const Dual& a, const Dual& b) {
  return {a.v * b.v, a.d * b.v + a.v * b.d};
}
DIFFSIM_INLINE Dual operator*(double k, const Dual& a) { return {k * a.v, k * a.d}; }
DIFFSIM_INLINE Dual operator+(double k, const Dual& a) { return {k + a.v, a.d}; }
DIFFSIM_INLINE Dual operator-(double k, const Dual& a) { return {k - a.v, -a.d}; }

DIFFSIM_INLINE Native value_of(const Native& a) { return a; }
DIFFSIM_INLINE Native value_of(const Dual& a) { return a.v; }
DIFFSIM_INLINE Native keep_lanes(const NativeMask& mask, const Native& a) { return keep(mask, a); }
DIFFSIM_INLINE Dual keep_lanes(const NativeMask& mask, const Dual& a) {
  return {keep(mask, a.v), keep(mask, a.d)};
}
/// 1 / a, and 0 where a is not positive.
DIFFSIM_INLINE Native inverse_or_zero(const Native& a) {
  const NativeMask some = less(Native{}, a);
  return keep(some, 1.0 / select(some, a, broadcast<Native>(1.0)));
}
DIFFSIM_INLINE Dual inverse_or_zero(const Dual& a) {
  const Native r = inverse_or_zero(a.v);
  return {r, -(r * r) * a.d};
}
/// |a| from |a|^2, with derivative 0 at 0.
DIFFSIM_INLINE Native root(const Native& square) { return sqrt(square); }
DIFFSIM_INLINE Dual root(const Dual& square) {
  const Native r = sqrt(square.v);
  return {r, 0.5 * inverse_or_zero(r) * square.d};
}

/// atan2(up, along) of up > 0, along >= 0, to about an ulp: the rational function of Cephes' atan
/// (Moshier) on |t| <= 0.66, with t = up / along turned by pi/4 or pi/2 beyond.
DIFFSIM_INLINE Native angle_of(const Native& up, const Native& along) {
  constexpr double kSteep = 2.41421356237309504880, kFlat = 0.66;  // tan of 3 pi/8
  const NativeMask steep = less(kSteep * along, up), flat = less(up, kFlat * along);
  const Native top = select(steep, -along, select(flat, up, up - along));
  const Native below = select(steep, up, select(flat, along, up + along));
  const Native start = select(steep, broadcast<Native>(0.5 * kPi),
                              select(flat, broadcast<Native>(0.0), broadcast<Native>(0.25 * kPi)));
  // What pi/2 and pi/4 lose as doubles.
  const Native rest =
      select(steep, broadcast<Native>(6.123233995736765886130e-17),
             select(flat, broadcast<Native>(0.0), broadcast<Native>(3.061616997868382943065e-17)));
  const Native t = top / below, z = t * t;
  Native p = -8.750608600031904122785e-1 * z - 1.615753718733365076637e1;
  p = p * z - 7.500855792314704667340e1;
  p = p * z - 1.228866684490136173410e2;
  p = p * z - 6.485021904942025371773e1;
  Native q = z + 2.485846490142306297962e1;
  q = q * z + 1.650270098316988542046e2;
  q = q * z + 4.328810604912902668951e2;
  q = q * z + 4.853903996359136964868e2;
  q = q * z + 1.945506571482613964425e2;
  return start + (t + (t * (z * p / q) + rest));
}
DIFFSIM_INLINE Dual angle_of(const Dual& up, const Dual& along) {
  const Native slope = inverse_or_zero(up.v * up.v + along.v * along.v);
  return {angle_of(up.v, along.v), slope * (along.v * up.d - up.v * along.d)};
}

template <class S>
DIFFSIM_INLINE S dot3(const S a[3], const S b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
template <class S>
DIFFSIM_INLINE void cross3(const S a[3], const S b[3], S out[3]) {
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    out[i] = a[j] * b[k] - a[k] * b[j];
  }
}
DIFFSIM_INLINE void add_cross3(const Native a[3], const Native b[3], Native out[3]) {
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    out[i] += a[j] * b[k] - a[k] * b[j];
  }
}

/// Bernstein polynomials of a cubic curve at t.
template <class S>
DIFFSIM_INLINE void bernstein(const S& t, S out[4]) {
  const S s = 1.0 - t;
  out[0] = s * s * s, out[1] = 3.0 * (s * s * t), out[2] = 3.0 * (s * t * t), out[3] = t * t * t;
}
template <class S>
DIFFSIM_INLINE S curve(const S ordinates[4], const S weights[4]) {
  return ordinates[0] * weights[0] + ordinates[1] * weights[1] + ordinates[2] * weights[2] +
         ordinates[3] * weights[3];
}
/// The curve's slope by t.
DIFFSIM_INLINE Native curve_slope(const Native p[4], const Native& t) {
  const Native s = 1.0 - t;
  return 3.0 * (s * s * (p[1] - p[0]) + 2.0 * (s * t) * (p[2] - p[1]) + t * t * (p[3] - p[2]));
}

/// 0 up to s = 0, 1 from s = 1 on, twice continuously differentiable.
DIFFSIM_INLINE Native rise(const Native& s) { return s * s * s * (10.0 - s * (15.0 - 6.0 * s)); }
DIFFSIM_INLINE Native faded(const Native& alpha, double fade_angle) {
  return rise(min(alpha / fade_angle, broadcast<Native>(1.0)));
}
DIFFSIM_INLINE Native faded_slope(const Native& alpha, double fade_angle) {
  const Native s = min(alpha / fade_angle, broadcast<Native>(1.0)), r = 1.0 - s;
  return 30.0 / fade_angle * (s * s * (r * r));
}
DIFFSIM_INLINE Dual faded(const Dual& alpha, double fade_angle) {
  return {faded(alpha.v, fade_angle), faded_slope(alpha.v, fade_angle) * alpha.d};
}

/// What all faces of a member share.
template <class S>
struct Water {
  S velocity[3], density, drag[4], thrust[4];
  double fade_angle;
};

/// Faces side by side: corners, and the mean velocity of those.
template <class S>
struct Faces {
  S x[kMostCorners][3], v[3];
};

/// The force on faces with what it is made of.
template <class S>
struct Flow {
  S edge[3][3], area_vector[3][3];  // of triangles 012, 023 and 013
  S total[3], inverse_length, normal[3], area;
  S relative[3], speed, head_on, across[3], along, alpha, fade, pressure;
  S drag_weights[4], thrust_weights[4], drag, thrust, force[3];
  NativeMask wet;
};

template <int kCorners, class S>
DIFFSIM_INLINE void find_flow(const Water<S>& water, const Faces<S>& faces, Flow<S>& f) {
  for (int k = 1; k < kCorners; ++k)
    for (int i = 0; i < 3; ++i) f.edge[k - 1][i] = faces.x[k][i] - faces.x[0][i];
  // A quad's area is the mean over its two triangulations, 012 and 023, or 013 and 312: both pairs
  // have the same sum.
  cross3(f.edge[0], f.edge[1], f.area_vector[0]);
  if constexpr (kCorners == 3) {
    for (int i = 0; i < 3; ++i) f.total[i] = f.area_vector[0][i];
  } else {
    cross3(f.edge[1], f.edge[2], f.area_vector[1]);
    cross3(f.edge[0], f.edge[2], f.area_vector[2]);
    for (int i = 0; i < 3; ++i) f.total[i] = f.area_vector[0][i] + f.area_vector[1][i];
  }
  const S length = root(dot3(f.total, f.total));
  f.inverse_length = inverse_or_zero(length);
  for (int i = 0; i < 3; ++i) f.normal[i] = f.inverse_length * f.total[i];
  if constexpr (kCorners == 3) {
    f.area = 0.5 * length;
  } else {
    S last[3];
    for (int i = 0; i < 3; ++i) last[i] = f.total[i] - f.area_vector[2][i];
    S lengths = root(dot3(last, last));
    for (const S(&vector)[3] : f.area_vector) lengths = lengths + root(dot3(vector, vector));
    f.area = 0.25 * lengths;
  }
  for (int i = 0; i < 3; ++i) f.relative[i] = water.velocity[i] - faces.v[i];
  f.speed = root(dot3(f.relative, f.relative));
  f.head_on = -1.0 * dot3(f.normal, f.relative);
  f.wet = less(Native{}, value_of(f.head_on));
  // asin(head_on / speed) without its infinite slope at head-on flow
  for (int i = 0; i < 3; ++i) f.across[i] = f.relative[i] + f.head_on * f.normal[i];
  f.along = root(dot3(f.across, f.across));
  f.alpha = keep_lanes(f.wet, angle_of(f.head_on, f.along));
  bernstein(2.0 / kPi * f.alpha, f.drag_weights);
  bernstein(0.5 + 1.0 / kPi * f.alpha, f.thrust_weights);
  f.drag = curve(water.drag, f.drag_weights);
  f.thrust = curve(water.thrust, f.thrust_weights);
  f.pressure = 0.5 * (water.density * f.area);
  if (water.fade_angle > 0.0) {
    f.fade = faded(f.alpha, water.fade_angle);
    f.pressure = f.pressure * f.fade;
  }
  f.pressure = keep_lanes(f.wet, f.pressure);
  const S by_relative = f.pressure * (f.drag * f.speed);
  const S by_normal = f.pressure * (f.thrust * (f.speed * f.speed));
  for (int i = 0; i < 3; ++i) f.force[i] = by_relative * f.relative[i] - by_normal * f.normal[i];
}

/// Gradients of what faces share, summed over faces lane by lane.
struct WaterGradient {
  Native velocity[3] = {}, density = {}, drag[4] = {}, thrust[4] = {};
};

DIFFSIM_INLINE void add_along(const Native& factor, const Native a[3], Native out[3]) {
  for (int i = 0; i < 3; ++i) out[i] += factor * a[i];
}

/// Gradients by the corners and by the mean velocity, from those by the force.
template <int kCorners>
DIFFSIM_INLINE void flow_adjoint(const Water<Native>& water, const Flow<Native>& f,
                                 const Native grad[3], Faces<Native>& out, WaterGradient& shared) {
  const Native wet = keep(f.wet, broadcast<Native>(1.0));
  const Native by_relative = wet * dot3(grad, f.relative), by_normal = wet * dot3(grad, f.normal);
  const Native speed2 = f.speed * f.speed;
  const Native by_pressure = f.drag * f.speed * by_relative - f.thrust * speed2 * by_normal;
  const Native by_drag = f.pressure * f.speed * by_relative;
  const Native by_thrust = -f.pressure * speed2 * by_normal;
  const Native by_speed =
      f.pressure * (f.drag * by_relative - 2.0 * f.thrust * f.speed * by_normal);
  Native by_alpha = by_drag * (2.0 / kPi) * curve_slope(water.drag, 2.0 / kPi * f.alpha) +
                    by_thrust * (1.0 / kPi) * curve_slope(water.thrust, 0.5 + 1.0 / kPi * f.alpha);
  Native half_pressure = 0.5 * by_pressure;
  if (water.fade_angle > 0.0) {
    by_alpha += half_pressure * water.density * f.area * faded_slope(f.alpha, water.fade_angle);
    half_pressure *= f.fade;
  }
  const Native by_area = half_pressure * water.density;
  shared.density += half_pressure * f.area;
  for (int k = 0; k < 4; ++k) {
    shared.drag[k] += by_drag * f.drag_weights[k];
    shared.thrust[k] += by_thrust * f.thrust_weights[k];
  }
  const Native slope = wet * by_alpha * inverse_or_zero(f.head_on * f.head_on + f.along * f.along);
  const Native on_across = -slope * f.head_on * inverse_or_zero(f.along);
  Native u[3] = {}, n[3] = {}, a[3] = {};  // by relative, normal, across
  add_along(on_across, f.across, a);
  const Native by_head_on = slope * f.along + dot3(a, f.normal);
  add_along(f.pressure * f.drag * f.speed, grad, u);
  add_along(by_speed * inverse_or_zero(f.speed), f.relative, u);
  add_along(-by_head_on, f.normal, u);
  for (int i = 0; i < 3; ++i) u[i] += a[i];
  add_along(-f.pressure * f.thrust * speed2, grad, n);
  add_along(-by_head_on, f.relative, n);
  add_along(f.head_on, a, n);
  for (int i = 0; i < 3; ++i) {
    u[i] *= wet, n[i] *= wet;
    shared.velocity[i] += u[i];
    out.v[i] = -u[i];
  }
  // normal = total / |total|
  Native total[3];
  const Native along_normal = dot3(n, f.normal);
  for (int i = 0; i < 3; ++i) total[i] = f.inverse_length * (n[i] - along_normal * f.normal[i]);
  Native edge[3][3] = {};
  if constexpr (kCorners == 3) {
    add_along(0.5 * by_area, f.normal, total);
    add_cross3(f.edge[1], total, edge[0]);
    add_cross3(total, f.edge[0], edge[1]);
  } else {
    Native vector[3][3] = {}, last[3];
    const Native quarter = 0.25 * by_area;
    for (int k = 0; k < 3; ++k) {
      const Native length = root(dot3(f.area_vector[k], f.area_vector[k]));
      add_along(quarter * inverse_or_zero(length), f.area_vector[k], vector[k]);
    }
    for (int i = 0; i < 3; ++i) last[i] = f.total[i] - f.area_vector[2][i];
    const Native on_last = quarter * inverse_or_zero(root(dot3(last, last)));
    for (int i = 0; i < 3; ++i) {
      total[i] += on_last * last[i];
      vector[0][i] += total[i];
      vector[1][i] += total[i];
      vector[2][i] -= on_last * last[i];
    }
    constexpr int kPairs[3][2] = {{0, 1}, {1, 2}, {0, 2}};
    for (int k = 0; k < 3; ++k) {
      const int a0 = kPairs[k][0], b0 = kPairs[k][1];
      add_cross3(f.edge[b0], vector[k], edge[a0]);
      add_cross3(vector[k], f.edge[a0], edge[b0]);
    }
  }
  for (int i = 0; i < 3; ++i) {
    out.x[0][i] = Native{};
    for (int k = 1; k < kCorners; ++k) {
      out.x[k][i] = edge[k - 1][i];
      out.x[0][i] -= edge[k - 1][i];
    }
  }
}

/// Nodes of the faces of a register, the last one again where there are no more.
template <int kCorners>
struct Corners {
  std::int64_t node[kNativeLanes][kCorners];
  int count;

  Corners(const WaterFaces& faces, std::int64_t first)
      : count(static_cast<int>(std::min<std::int64_t>(kNativeLanes, faces.num_faces - first))) {
    for (int lane = 0; lane < kNativeLanes; ++lane)
      for (int k = 0; k < kCorners; ++k)
        node[lane][k] = faces.nodes[(first + std::min(lane, count - 1)) * kCorners + k];
  }
  DIFFSIM_INLINE Native read(const double* nodal, int k, int i) const {
    double values[kNativeLanes];
    for (int lane = 0; lane < kNativeLanes; ++lane) values[lane] = nodal[3 * node[lane][k] + i];
    return load<Native>(values);
  }
  DIFFSIM_INLINE void read_mean(const double* nodal, Native out[3]) const {
    for (int i = 0; i < 3; ++i) {
      out[i] = read(nodal, 0, i);
      for (int k = 1; k < kCorners; ++k) out[i] += read(nodal, k, i);
      out[i] = out[i] / double{kCorners};
    }
  }
  Faces<Native> read(const double* x, const double* v) const {
    Faces<Native> faces;
    for (int k = 0; k < kCorners; ++k)
      for (int i = 0; i < 3; ++i) faces.x[k][i] = read(x, k, i);
    read_mean(v, faces.v);
    return faces;
  }
  /// Adds the faces' vectors to their corner k, in the order of the faces.
  void add(const Native vectors[3], int k, double* nodal) const {
    for (int lane = 0; lane < count; ++lane)
      for (int i = 0; i < 3; ++i) nodal[3 * node[lane][k] + i] += vectors[i][lane];
  }
  void add_shares(const Native vectors[3], double* nodal) const {
    Native share[3];
    for (int i = 0; i < 3; ++i) share[i] = vectors[i] / double{kCorners};
    for (int k = 0; k < kCorners; ++k) add(share, k, nodal);
  }
};

Native number(const double* p, std::int64_t i) { return broadcast<Native>(p ? p[i] : 0.0); }

Water<Native> water_of(const WaterInputs& in, double fade_angle, std::int64_t member) {
  Water<Native> water;
  for (int i = 0; i < 3; ++i) water.velocity[i] = number(in.water, 3 * member + i);
  water.density = number(in.density, 0);
  for (int i = 0; i < 4; ++i) {
    water.drag[i] = number(in.drag, i);
    water.thrust[i] = number(in.thrust, i);
  }
  water.fade_angle = fade_angle;
  return water;
}

template <int kCount>
void join_duals(const Native* value, const Native* direction, Dual* out) {
  for (int i = 0; i < kCount; ++i) out[i] = {value[i], direction[i]};
}

Water<Dual> join_duals(const Water<Native>& value, const Water<Native>& direction) {
  Water<Dual> water;
  join_duals<3>(value.velocity, direction.velocity, water.velocity);
  join_duals<1>(&value.density, &direction.density, &water.density);
  join_duals<4>(value.drag, direction.drag, water.drag);
  join_duals<4>(value.thrust, direction.thrust, water.thrust);
  water.fade_angle = value.fade_angle;
  return water;
}

/// Calls f(corners) for all faces, a register of them at a time.
template <int kCorners, typename F>
void for_faces(const WaterFaces& faces, F&& f) {
  for (std::int64_t first = 0; first < faces.num_faces; first += kNativeLanes)
    f(Corners<kCorners>(faces, first));
}

template <int kCorners>
void force_of_member(const WaterFaces& faces, const Water<Native>& water, const double* x,
                     const double* v, double* force) {
  for_faces<kCorners>(faces, [&](const Corners<kCorners>& corners) {
    Flow<Native> flow;
    find_flow<kCorners>(water, corners.read(x, v), flow);
    corners.add_shares(flow.force, force);
  });
}

template <int kCorners>
void adjoint_of_member(const WaterFaces& faces, const Water<Native>& water, const double* x,
                       const double* v, const double* grad_force, double* grad_x, double* grad_v,
                       WaterGradient& shared) {
  for_faces<kCorners>(faces, [&](const Corners<kCorners>& corners) {
    Flow<Native> flow;
    find_flow<kCorners>(water, corners.read(x, v), flow);
    Native grad[3];
    corners.read_mean(grad_force, grad);
    for (int i = 0; i < 3; ++i)  // faces that stand in for those that are missing count for nothing
      for (int lane = corners.count; lane < kNativeLanes; ++lane) grad[i][lane] = 0.0;
    Faces<Native> out;
    flow_adjoint<kCorners>(water, flow, grad, out, shared);
    for (int k = 0; k < kCorners; ++k) corners.add(out.x[k], k, grad_x);
    corners.add_shares(out.v, grad_v);
  });
}

template <int kCorners>
void tangent_of_member(const WaterFaces& faces, const Water<Dual>& water, const double* x,
                       const double* v, const double* dx, const double* dv, double* rate) {
  for_faces<kCorners>(faces, [&](const Corners<kCorners>& corners) {
    const Faces<Native> value = corners.read(x, v), direction = corners.read(dx, dv);
    Faces<Dual> both;
    for (int k = 0; k < kCorners; ++k) join_duals<3>(value.x[k], direction.x[k], both.x[k]);
    join_duals<3>(value.v, direction.v, both.v);
    Flow<Dual> flow;
    find_flow<kCorners>(water, both, flow);
    Native force_rate[3];
    for (int i = 0; i < 3; ++i) force_rate[i] = flow.force[i].d;
    corners.add_shares(force_rate, rate);
  });
}

void put_sum(const Native* values, int count, bool is_first, double* out) {
  for (int i = 0; i < count; ++i) out[i] = (is_first ? 0.0 : out[i]) + sum(values[i]);
}

}  // namespace

void water_force(const WaterFaces& faces, const WaterInputs& in, double fade_angle,
                 std::int64_t batch, double* force) {
  const std::int64_t size = 3 * faces.num_nodes;
  std::fill(force, force + batch * size, 0.0);
  const auto member = faces.corners == 3 ? force_of_member<3> : force_of_member<4>;
  for (std::int64_t k = 0; k < batch; ++k)
    member(faces, water_of(in, fade_angle, k), in.x + k * size, in.v + k * size, force + k * size);
}

void water_force_adjoint(const WaterFaces& faces, const WaterInputs& in, double fade_angle,
                         std::int64_t batch, const double* grad_force, const WaterAdjoint& out) {
  const std::int64_t size = 3 * faces.num_nodes;
  std::fill(out.x, out.x + batch * size, 0.0);
  std::fill(out.v, out.v + batch * size, 0.0);
  const auto member = faces.corners == 3 ? adjoint_of_member<3> : adjoint_of_member<4>;
  for (std::int64_t k = 0; k < batch; ++k) {
    WaterGradient shared;
    const std::int64_t at = k * size;
    member(faces, water_of(in, fade_angle, k), in.x + at, in.v + at, grad_force + at, out.x + at,
           out.v + at, shared);
    put_sum(shared.velocity, 3, true, out.water + 3 * k);
    put_sum(&shared.density, 1, k == 0, out.density);
    put_sum(shared.drag, 4, k == 0, out.drag);
    put_sum(shared.thrust, 4, k == 0, out.thrust);
  }
}

void water_force_tangent(const WaterFaces& faces, const WaterInputs& in, double fade_angle,
                         std::int64_t batch, const WaterInputs& direction, double* rate) {
  const std::int64_t size = 3 * faces.num_nodes;
  std::fill(rate, rate + batch * size, 0.0);
  const auto member = faces.corners == 3 ? tangent_of_member<3> : tangent_of_member<4>;
  for (std::int64_t k = 0; k < batch; ++k) {
    const std::int64_t at = k * size;
    const Water<Dual> water =
        join_duals(water_of(in, fade_angle, k), water_of(direction, fade_angle, k));
    member(faces, water, in.x + at, in.v + at, direction.x + at, direction.v + at, rate + at);
  }
}

}  // namespace diffsim
