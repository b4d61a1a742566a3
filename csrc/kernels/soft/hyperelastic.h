// Isotropic hyperelastic solids, one sample per lane of T: energy density psi(s) [J/m^3] of the
// principal stretches, principal stresses psi_i and the principal tangent, all in closed form.
//
// The weights w[0] = 2 mu and w[1] = lambda are the small-strain Lame parameters of linear
// elasticity: E, nu in = E, nu out. Every energy is linear in its weights. With e = s - 1, a = tr e
// and J = s0 s1 s2:
//
//   corotated            mu |e|^2 + lambda/2 a^2, that is mu |S - I|^2 + lambda/2 tr(S - I)^2
//   stable neo-Hookean   m/2 (I - 3) - m/2 ln((I + 1)/4) - mu (J - 1) + l/2 (J - 1)^2,  I = |F|^2
//                        m = 4/3 mu, l = lambda + 5/6 mu (Smith, de Goes, Kim 2018, eqs. 13-16,
//                        less the constant that makes psi(I) = 0)
//   neo-Hookean          mu/2 (I - 3) - mu ln J + lambda/2 (ln J)^2; infinite where J <= 0
//   St. Venant-Kirchhoff mu |E|^2 + lambda/2 tr(E)^2,  E = (s^2 - 1)/2
//   Mooney-Rivlin        c1 (I - 3) + c2 (I2 - 3) - 2 (c1 + 2 c2) ln J + (lambda - 4 c2)/2 (ln
//   J)^2,
//                        I2 = |cof F|^2; w[0] = 4 c1, w[2] = 4 c2, so that w[0] + w[2] = 2 mu;
//                        infinite where J <= 0
//
// The formulas below are these, rearranged so that every term is of second order in e near rest:
// as written, the energy of a small strain would be the difference of first-order terms.
#pragma once

#include "kernels/linalg/lane_log.h"
#include "kernels/soft/jets.h"

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
  static constexpr const char* kName = "corotated";
  static constexpr int kWeights = 2;

  template <class T>
  using Sample = StretchSample<T>;

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T d[3]) {
    for (int i = 0; i < 3; ++i) d[i] = w[0] * p.e[i] + w[1] * p.trace;
    return 0.5 * (w[0] * p.square + w[1] * p.trace * p.trace);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T w[kWeights]) {
    PrincipalTangent<T> c;
    for (int i = 0; i < 9; ++i) c.diagonal[i] = i % 4 == 0 ? w[0] + w[1] : w[1];
    for (int k = 0; k < 3; ++k) {
      // s_i + s_j = 0 is where the nearest rotation is not unique: the derivative is unbounded.
      const T s = max(p.s[kPair[k][0]] + p.s[kPair[k][1]], broadcast<T>(1e-12));
      c.symmetric[k] = w[0];
      c.skew[k] = w[0] + 2.0 * (w[1] * p.trace - w[0]) / s;
    }
    return c;
  }

  template <class T>
  static void jets(const Sample<T>& p, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
    Jet<T> R[9];
    rotation_jets(p.s, F, R);
    Jet<T> trace = R[0] * F[0];
    for (int i = 1; i < 9; ++i) trace = trace + R[i] * F[i];
    for (int i = 0; i < 9; ++i) P[0][i] = F[i] - R[i], P[1][i] = (trace + -3.0) * R[i];
  }
};

struct StableNeoHookeanMaterial {
  static constexpr const char* kName = "stable_neo_hookean";
  static constexpr int kWeights = 2;

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
  static T stress(const Sample<T>& p, const T w[kWeights], T d[3]) {
    const T mu = 0.5 * w[0], l = w[1] + (5.0 / 6.0) * mu;
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
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T w[kWeights]) {
    PrincipalTangent<T> c;
    const T mu = 0.5 * w[0], l = w[1] + (5.0 / 6.0) * mu;
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

  template <class T>
  static void jets(const Sample<T>&, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
    Jet<T> C[9];
    const Jet<T> growth = cofactors(F, C) + -1.0;
    // m = 2/3 w[0], mu = w[0] / 2, l = w[1] + 5/12 w[0]
    const Jet<T> stiffness = (-2.0 / 3.0) * inverse(squared_norm(F) + 1.0) + 2.0 / 3.0;
    const Jet<T> pressure = (5.0 / 12.0) * growth + -0.5;
    for (int i = 0; i < 9; ++i) {
      P[0][i] = stiffness * F[i] + pressure * C[i];
      P[1][i] = growth * C[i];
    }
  }
};

struct NeoHookeanMaterial {
  static constexpr const char* kName = "neo_hookean";
  static constexpr int kWeights = 2;

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

    /// An energy where J > 0, and infinity elsewhere.
    T where_upright(const T& psi) const {
      return select(less(broadcast<T>(0.0), s[2]), psi,
                    broadcast<T>(std::numeric_limits<double>::infinity()));
    }
  };

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T d[3]) {
    const T mu = 0.5 * w[0];
    for (int i = 0; i < 3; ++i)
      d[i] = (mu * p.e[i] * (p.s[i] + 1.0) + w[1] * p.log_J) * p.inverse[i];
    const T psi = mu * (0.5 * p.square + p.gap) + 0.5 * w[1] * p.log_J * p.log_J;
    return p.where_upright(psi);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T w[kWeights]) {
    PrincipalTangent<T> c;
    const T mu = 0.5 * w[0], pressure = w[1] * p.log_J - mu;  // s_i times the ln J terms
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        c.diagonal[3 * i + j] = i == j ? mu + (w[1] - pressure) * p.inverse[i] * p.inverse[i]
                                       : w[1] * p.inverse[i] * p.inverse[j];
    for (int k = 0; k < 3; ++k) {
      const T twist = pressure * p.inverse[kPair[k][0]] * p.inverse[kPair[k][1]];
      c.symmetric[k] = mu - twist;
      c.skew[k] = mu + twist;
    }
    return c;
  }

  template <class T>
  static void jets(const Sample<T>& p, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
    Jet<T> C[9];
    const Jet<T> J = cofactors(F, C);
    const Jet<T> over = inverse(J), log_over = logarithm(J, p.log_J) * over;
    for (int i = 0; i < 9; ++i) {
      P[0][i] = 0.5 * (F[i] - over * C[i]);
      P[1][i] = log_over * C[i];
    }
  }
};

struct StvkMaterial {
  static constexpr const char* kName = "stvk";
  static constexpr int kWeights = 2;

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
  static T stress(const Sample<T>& p, const T w[kWeights], T d[3]) {
    const T pressure = w[1] * p.green_trace;
    T square = broadcast<T>(0.0);
    for (int i = 0; i < 3; ++i) {
      d[i] = p.s[i] * (w[0] * p.green[i] + pressure);
      square += p.green[i] * p.green[i];
    }
    return 0.5 * (w[0] * square + pressure * p.green_trace);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T w[kWeights]) {
    PrincipalTangent<T> c;
    const T pressure = w[1] * p.green_trace;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const T product = p.s[i] * p.s[j];
        c.diagonal[3 * i + j] = w[1] * product + (i == j ? w[0] * (p.green[i] + product) + pressure
                                                         : broadcast<T>(0.0));
      }
    for (int k = 0; k < 3; ++k) {
      const int i = kPair[k][0], j = kPair[k][1];
      // (s_i^2 + s_j^2 - 1)/2, apart from the mixed term
      const T squares = p.green[i] + p.green[j] + 0.5, mixed = 0.5 * p.s[i] * p.s[j];
      c.symmetric[k] = w[0] * (squares + mixed) + pressure;
      c.skew[k] = w[0] * (squares - mixed) + pressure;
    }
    return c;
  }

  template <class T>
  static void jets(const Sample<T>&, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
    const Jet<T> trace = 0.5 * squared_norm(F) + -1.5;
    Jet<T> E[9];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const Jet<T> C = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
        E[3 * i + j] = 0.5 * (C + (i == j ? -1.0 : 0.0));
      }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const int ij = 3 * i + j;
        P[0][ij] = F[3 * i] * E[j] + F[3 * i + 1] * E[3 + j] + F[3 * i + 2] * E[6 + j];
        P[1][ij] = trace * F[ij];
      }
  }
};

/// The neo-Hookean solid with a weight of its own for the second invariant.
struct MooneyRivlinMaterial {
  static constexpr const char* kName = "mooney_rivlin";
  static constexpr int kWeights = 3;

  template <class T>
  struct Sample : NeoHookeanMaterial::Sample<T> {
    using Base = NeoHookeanMaterial::Sample<T>;
    using Base::s, Base::e;
    T green[3];  // s^2 - 1

    explicit Sample(const PrincipalFrame<T>& frame) : Base(frame) {
      for (int i = 0; i < 3; ++i) green[i] = e[i] * (s[i] + 1.0);
    }
  };

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T d[3]) {
    const T psi = NeoHookeanMaterial::stress(p, w, d);
    const T* g = p.green;
    for (int i = 0; i < 3; ++i) {
      const T others = g[(i + 1) % 3] + g[(i + 2) % 3];
      d[i] += w[2] * (g[i] + 0.5 * (1.0 + g[i]) * others - p.log_J) * p.inverse[i];
    }
    const T pairs = g[0] * g[1] + g[0] * g[2] + g[1] * g[2];
    const T second = 0.5 * p.square + p.gap + 0.25 * pairs - 0.5 * p.log_J * p.log_J;
    return p.where_upright(psi + w[2] * second);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T w[kWeights]) {
    PrincipalTangent<T> c = NeoHookeanMaterial::tangent(p, w);
    const T half = 0.5 * w[2];
    for (int i = 0; i < 3; ++i) {
      const T others = p.green[(i + 1) % 3] + p.green[(i + 2) % 3] + 2.0;
      c.diagonal[4 * i] += half * others + w[2] * p.log_J * p.inverse[i] * p.inverse[i];
    }
    for (int k = 0; k < 3; ++k) {
      const int i = kPair[k][0], j = kPair[k][1];
      const T product = p.s[i] * p.s[j], inverse = p.inverse[i] * p.inverse[j];
      const T mixed = w[2] * (product - inverse), square = half * (p.green[third(i, j)] + 1.0);
      const T twist = w[2] * (1.0 + p.log_J) * inverse - half * product;
      c.diagonal[3 * i + j] += mixed;
      c.diagonal[3 * j + i] += mixed;
      c.symmetric[k] += square + twist;
      c.skew[k] += square - twist;
    }
    return c;
  }

  template <class T>
  static void jets(const Sample<T>& p, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
    NeoHookeanMaterial::jets(p, F, P);
    Jet<T> C[9], G[9];  // cof F, F^T F
    const Jet<T> over = inverse(cofactors(F, C)), square = squared_norm(F);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        G[3 * i + j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const int ij = 3 * i + j;
        const Jet<T> FG = F[3 * i] * G[j] + F[3 * i + 1] * G[3 + j] + F[3 * i + 2] * G[6 + j];
        P[2][ij] = 0.5 * (square * F[ij] - FG) - over * C[ij] - P[1][ij];
      }
  }
};

}  // namespace diffsim
