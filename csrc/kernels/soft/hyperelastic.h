// Isotropic hyperelastic solids, one sample per lane of T: energy density psi(s) [J/m^3] of the
// principal stretches, principal stresses psi_i and the principal tangent, all in closed form.
//
// w_mu = 2 mu and w_vol = lambda are the small-strain Lame parameters of linear elasticity: E, nu
// in = E, nu out. Every energy is linear in both. With e = s - 1, a = tr e and J = s0 s1 s2:
//
//   corotated            mu |e|^2 + lambda/2 a^2, that is mu |S - I|^2 + lambda/2 tr(S - I)^2
//   stable neo-Hookean   m/2 (I - 3) - m/2 ln((I + 1)/4) - mu (J - 1) + l/2 (J - 1)^2,  I = |F|^2
//                        m = 4/3 mu, l = lambda + 5/6 mu (Smith, de Goes, Kim 2018, eqs. 13-16,
//                        less the constant that makes psi(I) = 0)
//   neo-Hookean          mu/2 (I - 3) - mu ln J + lambda/2 (ln J)^2; infinite where J <= 0
//   St. Venant-Kirchhoff mu |E|^2 + lambda/2 tr(E)^2,  E = (s^2 - 1)/2
//
// The formulas below are these, rearranged so that every term is of second order in e near rest:
// as written, the energy of a small strain would be the difference of first-order terms.
#pragma once

#include "kernels/linalg/lane_log.h"
#include "kernels/soft/principal.h"

namespace diffsim {

/// What the energies are made of, from the stretches.
template <class T>
struct StretchSample : PrincipalFrame<T> {
  using PrincipalFrame<T>::s;
  T e[3];
  T trace, square;  // sum of e, sum of e^2

  explicit StretchSample(const PrincipalFrame<T>& frame) : PrincipalFrame<T>(frame) {
    for (int i = 0; i < 3; ++i) e[i] = s[i] - 1.0;
    trace = e[0] + e[1] + e[2];
    square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2];
  }
};

/// The index that a pair leaves out.
inline constexpr int third(int i, int j) { return 3 - i - j; }

struct CorotatedMaterial {
  template <class T>
  using Sample = StretchSample<T>;

  template <class T>
  static T stress(const Sample<T>& p, const T& w_mu, const T& w_vol, T d[3]) {
    for (int i = 0; i < 3; ++i) d[i] = w_mu * p.e[i] + w_vol * p.trace;
    return 0.5 * (w_mu * p.square + w_vol * p.trace * p.trace);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T& w_mu, const T& w_vol) {
    PrincipalTangent<T> c;
    for (int i = 0; i < 9; ++i) c.diagonal[i] = i % 4 == 0 ? w_mu + w_vol : w_vol;
    for (int k = 0; k < 3; ++k) {
      // s_i + s_j = 0 is where the nearest rotation is not unique: the derivative is unbounded.
      const T s = max(p.s[kPair[k][0]] + p.s[kPair[k][1]], broadcast<T>(1e-12));
      c.symmetric[k] = w_mu;
      c.skew[k] = w_mu + 2.0 * (w_vol * p.trace - w_mu) / s;
    }
    return c;
  }
};

struct StableNeoHookeanMaterial {
  template <class T>
  struct Sample : StretchSample<T> {
    using StretchSample<T>::s, StretchSample<T>::e, StretchSample<T>::trace;
    using StretchSample<T>::square;
    T u;            // (I - 3)/4
    T pairs;        // J - 1 = trace + pairs
    T cofactor[3];  // dJ/ds

    explicit Sample(const PrincipalFrame<T>& frame) : StretchSample<T>(frame) {
      u = 0.25 * (2.0 * trace + square);
      pairs = e[0] * e[1] + e[0] * e[2] + e[1] * e[2] + e[0] * e[1] * e[2];
      cofactor[0] = s[1] * s[2], cofactor[1] = s[0] * s[2], cofactor[2] = s[0] * s[1];
    }
  };

  template <class T>
  static T stress(const Sample<T>& p, const T& w_mu, const T& w_vol, T d[3]) {
    const T mu = 0.5 * w_mu, l = w_vol + (5.0 / 6.0) * mu;
    const T growth = p.trace + p.pairs, third_mu = mu * (1.0 / 3.0);
    const T barrier = third_mu * p.u / (1.0 + p.u);
    for (int i = 0; i < 3; ++i) {
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      const T deviator = p.e[i] - p.e[j] - p.e[k] - p.e[j] * p.e[k];  // s_i - s_j s_k
      d[i] = mu * deviator + barrier * p.s[i] + l * growth * p.cofactor[i];
    }
    return mu * (0.5 * p.square - p.pairs) + 2.0 * third_mu * log_gap(p.u) +
           0.5 * l * growth * growth;
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T& w_mu, const T& w_vol) {
    PrincipalTangent<T> c;
    const T mu = 0.5 * w_mu, l = w_vol + (5.0 / 6.0) * mu;
    const T inverse = 1.0 / (4.0 + 4.0 * p.u);               // 1/(I + 1)
    const T stiffness = (4.0 / 3.0) * mu * (1.0 - inverse);  // m (1 - 1/(I + 1))
    const T bend = (8.0 / 3.0) * mu * inverse * inverse;
    const T pressure = l * (p.trace + p.pairs) - mu;  // dpsi/dJ
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const T common = bend * p.s[i] * p.s[j] + l * p.cofactor[i] * p.cofactor[j];
        c.diagonal[3 * i + j] = common + (i == j ? stiffness : pressure * p.s[third(i, j) % 3]);
      }
    for (int k = 0; k < 3; ++k) {
      const T twist = pressure * p.s[third(kPair[k][0], kPair[k][1])];
      c.symmetric[k] = stiffness - twist;
      c.skew[k] = stiffness + twist;
    }
    return c;
  }
};

struct NeoHookeanMaterial {
  template <class T>
  struct Sample : StretchSample<T> {
    using StretchSample<T>::s, StretchSample<T>::e, StretchSample<T>::trace;
    using StretchSample<T>::square;
    T gap;         // sum of e - ln s
    T log_J;       // ln J
    T inverse[3];  // 1/s

    explicit Sample(const PrincipalFrame<T>& frame) : StretchSample<T>(frame) {
      gap = log_gap(e[0]) + log_gap(e[1]) + log_gap(e[2]);  // infinite where J <= 0
      log_J = trace - gap;
      for (int i = 0; i < 3; ++i) inverse[i] = 1.0 / s[i];
    }
  };

  template <class T>
  static T stress(const Sample<T>& p, const T& w_mu, const T& w_vol, T d[3]) {
    const T mu = 0.5 * w_mu;
    for (int i = 0; i < 3; ++i)
      d[i] = (mu * p.e[i] * (p.s[i] + 1.0) + w_vol * p.log_J) * p.inverse[i];
    const T psi = mu * (0.5 * p.square + p.gap) + 0.5 * w_vol * p.log_J * p.log_J;
    return select(less(broadcast<T>(0.0), p.s[2]), psi,
                  broadcast<T>(std::numeric_limits<double>::infinity()));
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T& w_mu, const T& w_vol) {
    PrincipalTangent<T> c;
    const T mu = 0.5 * w_mu, pressure = w_vol * p.log_J - mu;  // s_i times the ln J terms
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        c.diagonal[3 * i + j] = i == j ? mu + (w_vol - pressure) * p.inverse[i] * p.inverse[i]
                                       : w_vol * p.inverse[i] * p.inverse[j];
    for (int k = 0; k < 3; ++k) {
      const T twist = pressure * p.inverse[kPair[k][0]] * p.inverse[kPair[k][1]];
      c.symmetric[k] = mu - twist;
      c.skew[k] = mu + twist;
    }
    return c;
  }
};

struct StvkMaterial {
  template <class T>
  struct Sample : StretchSample<T> {
    using StretchSample<T>::s, StretchSample<T>::e, StretchSample<T>::trace;
    using StretchSample<T>::square;
    T green[3];  // (s^2 - 1)/2
    T green_trace;

    explicit Sample(const PrincipalFrame<T>& frame) : StretchSample<T>(frame) {
      for (int i = 0; i < 3; ++i) green[i] = 0.5 * e[i] * (s[i] + 1.0);
      green_trace = green[0] + green[1] + green[2];
    }
  };

  template <class T>
  static T stress(const Sample<T>& p, const T& w_mu, const T& w_vol, T d[3]) {
    const T pressure = w_vol * p.green_trace;
    T square = broadcast<T>(0.0);
    for (int i = 0; i < 3; ++i) {
      d[i] = p.s[i] * (w_mu * p.green[i] + pressure);
      square += p.green[i] * p.green[i];
    }
    return 0.5 * (w_mu * square + pressure * p.green_trace);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T& w_mu, const T& w_vol) {
    PrincipalTangent<T> c;
    const T pressure = w_vol * p.green_trace;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const T product = p.s[i] * p.s[j];
        c.diagonal[3 * i + j] = w_vol * product + (i == j ? w_mu * (p.green[i] + product) + pressure
                                                          : broadcast<T>(0.0));
      }
    for (int k = 0; k < 3; ++k) {
      const int i = kPair[k][0], j = kPair[k][1];
      // (s_i^2 + s_j^2 - 1)/2, apart from the mixed term
      const T squares = p.green[i] + p.green[j] + 0.5, mixed = 0.5 * p.s[i] * p.s[j];
      c.symmetric[k] = w_mu * (squares + mixed) + pressure;
      c.skew[k] = w_mu * (squares - mixed) + pressure;
    }
    return c;
  }
};

}  // namespace diffsim
