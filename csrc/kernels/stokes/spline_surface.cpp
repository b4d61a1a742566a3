#include "kernels/stokes/spline_surface.h"

#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

Four load_four(const double* from) {
  Four a;
  std::memcpy(&a, from, sizeof(a));
  return a;
}

/// The parameter on one turn, or clamped to the knots.
double inside_of(const SplineAxis& axis, double u) {
  return std::isinf(axis.low) ? u - std::floor(u) : std::clamp(u, 0.0, 1.0);
}

std::int64_t span_of(const SplineAxis& axis, double inside) {
  const double* end = axis.breaks + axis.num_spans;  // the last break ends the last span
  const std::int64_t after = std::upper_bound(axis.breaks + 1, end, inside) - (axis.breaks + 1);
  return std::min(after, axis.num_spans - 1);
}

}  // namespace

SurfaceEvaluator::SurfaceEvaluator(const SplineSurface& surface) : surface_(surface) {
  for (int k = 0; k < 2; ++k) {
    const SplineAxis& axis = surface.axes[k];
    const int count = axis.degree + 1;
    powers_[k].assign(axis.num_spans * count * kActive, 0.0);
    for (std::int64_t span = 0; span < axis.num_spans; ++span)
      for (int i = 0; i < count; ++i)
        for (int power = 0; power < count; ++power)
          powers_[k][(span * count + power) * kActive + i] =
              axis.coefficients[(span * count + i) * count + power];
  }
}

void SurfaceEvaluator::basis(int k, double u, Basis& out) const {
  const SplineAxis& axis = surface_.axes[k];
  const double inside = inside_of(axis, u);
  const std::int64_t span = span_of(axis, inside);
  const double per_h = 1.0 / (axis.breaks[span + 1] - axis.breaks[span]);
  const double x = (inside - axis.breaks[span]) * per_h;
  const double beyond = std::isinf(axis.low) ? 0.0 : u - inside;
  const double* of_span = powers_[k].data() + span * (axis.degree + 1) * kActive;
  out.first = axis.first[span];
  for (int part = 0; part <= axis.degree; part += 4) {
    Four value{}, slope{}, half_bend{};  // Horner's scheme, with derivatives
    for (int power = axis.degree; power >= 0; --power) {
      half_bend = half_bend * x + slope;
      slope = slope * x + value;
      value = value * x + load_four(of_span + power * kActive + part);
    }
    slope *= per_h;
    Four bend = (2.0 * per_h * per_h) * half_bend;
    if (beyond != 0.0) {
      value += beyond * slope;
      bend = Four{};
    }
    std::memcpy(out.of[0] + part, &value, sizeof(Four));
    std::memcpy(out.of[1] + part, &slope, sizeof(Four));
    std::memcpy(out.of[2] + part, &bend, sizeof(Four));
  }
}

SurfaceJet SurfaceEvaluator::at(const double (&uv)[2]) const {
  Basis u, v;
  basis(0, uv[0], u);
  basis(1, uv[1], v);
  const std::int64_t nu = surface_.axes[0].num, nv = surface_.axes[1].num;
  Four h{}, hu{}, hv{}, huu{}, huv{}, hvv{};
  std::int64_t row = u.first;
  for (int i = 0; i <= surface_.axes[0].degree; ++i) {
    const double* points = surface_.homogeneous + 4 * nv * row;
    Four a{}, av{}, avv{};
    std::int64_t column = v.first;
    for (int j = 0; j <= surface_.axes[1].degree; ++j) {
      const Four c = load_four(points + 4 * column);
      a += v.of[0][j] * c;
      av += v.of[1][j] * c;
      avv += v.of[2][j] * c;
      column = column + 1 == nv ? 0 : column + 1;
    }
    h += u.of[0][i] * a;
    hu += u.of[1][i] * a;
    hv += u.of[0][i] * av;
    huu += u.of[2][i] * a;
    huv += u.of[1][i] * av;
    hvv += u.of[0][i] * avv;
    row = row + 1 == nu ? 0 : row + 1;
  }
  SurfaceJet jet;  // quotient rule: w s = h, differentiated
  const double w = h[3];
  jet.s = h / w;
  jet.su = (hu - hu[3] * jet.s) / w;
  jet.sv = (hv - hv[3] * jet.s) / w;
  jet.suu = (huu - 2.0 * hu[3] * jet.su - huu[3] * jet.s) / w;
  jet.svv = (hvv - 2.0 * hv[3] * jet.sv - hvv[3] * jet.s) / w;
  jet.suv = (huv - hu[3] * jet.sv - hv[3] * jet.su - huv[3] * jet.s) / w;
  return jet;
}

void surface_frames(const SplineSurface& surface, const double* uv, std::int64_t num_points,
                    double* frames) {
  const SurfaceEvaluator evaluator(surface);
  for (std::int64_t i = 0; i < num_points; ++i) {
    const SurfaceJet jet = evaluator.at({uv[2 * i], uv[2 * i + 1]});
    std::memcpy(frames + 9 * i, &jet.s, 3 * sizeof(double));
    std::memcpy(frames + 9 * i + 3, &jet.su, 3 * sizeof(double));
    std::memcpy(frames + 9 * i + 6, &jet.sv, 3 * sizeof(double));
  }
}

}  // namespace diffsim
