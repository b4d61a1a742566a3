// Isotropic hyperelastic solids, one sample per lane of T: energy density psi(F) [J/m^3], first
// Piola stress and tangent in closed form, without singular values.
//
// The weights w[0] = 2 mu and w[1] = lambda are the small-strain Lame parameters of linear
// elasticity: E, nu in = E, nu out. Every energy is linear in its weights. With the nearest
// rotation R, I = |F|^2 and J = det F:
//
//   corotated            mu |F - R|^2 + lambda/2 (R : F - 3)^2
//   stable neo-Hookean   m/2 (I - 3) - m/2 ln((I + 1)/4) - mu (J - 1) + l/2 (J - 1)^2
//                        m = 4/3 mu, l = lambda + 5/6 mu (Smith, de Goes, Kim 2018, eqs. 13-16,
//                        less the constant that makes psi(I) = 0)
//   neo-Hookean          mu/2 (I - 3) - mu ln J + lambda/2 (ln J)^2; infinite where J <= 0
//   St. Venant-Kirchhoff mu |E|^2 + lambda/2 tr(E)^2,  E = (F^T F - 1)/2
//   Mooney-Rivlin        c1 (I - 3) + c2 (I2 - 3) - 2 (c1 + 2 c2) ln J + (lambda - 4 c2)/2 (ln
//   J)^2,
//                        I2 = |cof F|^2; w[0] = 4 c1, w[2] = 4 c2, so that w[0] + w[2] = 2 mu;
//                        infinite where J <= 0
//
// The energies below are these, rearranged so that every term is of second order in the strain near
// rest: as written, the energy of a small strain would be the difference of first-order terms.
//
// Tangents H[9 a + b] = dP_a / dF_b are written for a <= b; the rest, the mirror image, is left as
// it is. i, j and k, l are rows and columns of a and b.
#pragma once

#include <new>

#include "kernels/linalg/lane_log.h"
#include "kernels/soft/jets.h"

namespace diffsim {

/// Calls f(i, j, k, l) for every entry of a tangent on or above its diagonal.
template <typename Entry>
DIFFSIM_INLINE void for_upper(Entry&& f) {
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i)
#pragma GCC unroll 3
    for (int k = i; k < 3; ++k)
#pragma GCC unroll 3
      for (int j = 0; j < 3; ++j)
#pragma GCC unroll 3
        for (int l = i == k ? j : 0; l < 3; ++l) f(i, j, k, l);
}

/// The index that two different ones leave out.
inline constexpr int third(int i, int j) { return 3 - i - j; }
/// Place of an entry of a symmetric matrix among six, row by row from the diagonal.
inline constexpr int sixth(int i, int j) {
  return i <= j ? (i == 0 ? j : i + j + 1) : (j == 0 ? i : i + j + 1);
}

template <class T>
DIFFSIM_INLINE T dot9(const T A[9], const T B[9]) {
  T total = A[0] * B[0];
  for (int i = 1; i < 9; ++i) total += A[i] * B[i];
  return total;
}

/// F and Green's strain, of which small strains keep their digits: with G = F - 1 it is
/// (G + G^T + G^T G)/2.
template <class T>
struct StrainSample {
  T F[9];
  T E[6];  // sixth()
  T trace;

  explicit StrainSample(const T given[9]) {
    T G[9];
    for (int i = 0; i < 9; ++i) F[i] = given[i], G[i] = i % 4 == 0 ? F[i] - 1.0 : F[i];
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j)
        E[sixth(i, j)] = 0.5 * ((G[3 * i + j] + G[3 * j + i]) +
                                (G[i] * G[j] + G[3 + i] * G[3 + j] + G[6 + i] * G[6 + j]));
    trace = E[0] + E[3] + E[5];
  }
  T square() const {
    return E[0] * E[0] + E[3] * E[3] + E[5] * E[5] +
           2.0 * (E[1] * E[1] + E[2] * E[2] + E[4] * E[4]);
  }
};

/// The same with the change of volume.
template <class T>
struct VolumeSample : StrainSample<T> {
  using StrainSample<T>::F, StrainSample<T>::E, StrainSample<T>::trace;
  T cofactor[9];  // dJ/dF
  T J, growth;    // det F, less 1
  T minors;       // second invariant of E
  T excess;       // tr E - growth, of second order

  explicit VolumeSample(const T given[9]) : StrainSample<T>(given) {
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const int a = 3 * ((i + 1) % 3), b = 3 * ((i + 2) % 3), c = (j + 1) % 3, d = (j + 2) % 3;
        cofactor[3 * i + j] = F[a + c] * F[b + d] - F[a + d] * F[b + c];
      }
    J = F[0] * cofactor[0] + F[1] * cofactor[1] + F[2] * cofactor[2];
    growth = J - 1.0;
    const T first = E[3] * E[5] - E[4] * E[4];
    minors = first + E[0] * (E[3] + E[5]) - E[1] * E[1] - E[2] * E[2];
    const T det =
        E[0] * first - E[1] * (E[1] * E[5] - E[2] * E[4]) + E[2] * (E[1] * E[4] - E[2] * E[3]);
    // J^2 = det(1 + 2 E); where strains are large, the difference itself has more digits.
    const T small = 0.5 * growth * growth - 2.0 * minors - 4.0 * det;
    excess = select(less(this->square(), broadcast<T>(0.25)), small, trace - growth);
  }
};

/// The same with the logarithm of the volume and F^-T.
template <class T>
struct LogSample : VolumeSample<T> {
  using VolumeSample<T>::J, VolumeSample<T>::growth, VolumeSample<T>::excess;
  T inverse[9];  // F^-T
  T log_J;
  T gap;  // tr E - ln J, infinite where J <= 0

  explicit LogSample(const T given[9]) : VolumeSample<T>(given) {
    const T over = log_gap(growth, J);
    log_J = growth - over;
    gap = excess + over;
    const T one_over = 1.0 / J;
    for (int i = 0; i < 9; ++i) inverse[i] = one_over * this->cofactor[i];
  }
  /// An energy where J > 0, and infinity elsewhere.
  T where_upright(const T& psi) const {
    return select(less(broadcast<T>(0.0), J), psi,
                  broadcast<T>(std::numeric_limits<double>::infinity()));
  }
};

/// F and the nearest rotation.
template <class T>
struct RotationSample {
  T F[9], R[9];
  T trace;  // of the stretch, less 3

  RotationSample(const T given[9], const T rotation[9]) {
    trace = broadcast<T>(0.0);
    for (int i = 0; i < 9; ++i) {
      F[i] = given[i], R[i] = rotation[i];
      trace += R[i] * (F[i] - R[i]);
    }
  }
  explicit RotationSample(const T given[9]) : RotationSample(given, Rotation(given).R) {}

  /// Those of `count` registers, two at a time: see registers.h.
  static void make(const T (*F)[9], int count, RotationSample* out) {
    for (int r = 0; r < count; r += 2) {
      const int other = r + 1 < count ? r + 1 : r;
      Registers<T, 2> f[9], both[9];
      T first[9], second[9];
      for (int i = 0; i < 9; ++i) f[i] = {{F[r][i], F[other][i]}};
      detail::polar3_core(f, both);
      for (int i = 0; i < 9; ++i) first[i] = both[i].at[0], second[i] = both[i].at[1];
      new (out + r) RotationSample(F[r], first);
      if (other != r) new (out + other) RotationSample(F[other], second);
    }
  }

 private:
  struct Rotation {
    T R[9];
    explicit Rotation(const T F[9]) { detail::polar3_core(F, R); }
  };
};

struct CorotatedMaterial {
  static constexpr const char* kName = "corotated";
  static constexpr int kWeights = 2;
  static constexpr bool kKeepsSamples = true, kJetsInFrame = true;

  template <class T>
  using Sample = RotationSample<T>;

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T P[9]) {
    const T pressure = w[1] * p.trace;
    T square = broadcast<T>(0.0);
    for (int i = 0; i < 9; ++i) {
      const T stretch = p.F[i] - p.R[i];
      P[i] = w[0] * stretch + pressure * p.R[i];
      square += stretch * stretch;
    }
    return 0.5 * (w[0] * square + pressure * p.trace);
  }

  /// dR = sum of R e_m (K^-1)_mn (R e_n : dF) with e_m the cross products of the axes and
  /// K = tr(S) 1 - S, S the stretch.
  template <class T>
  static void tangent(const Sample<T>& p, const T w[kWeights], T H[81]) {
    const T* R = p.R;
    T S[6];
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j)
        S[sixth(i, j)] = 0.5 * (R[i] * p.F[j] + R[3 + i] * p.F[3 + j] + R[6 + i] * p.F[6 + j] +
                                R[j] * p.F[i] + R[3 + j] * p.F[3 + i] + R[6 + j] * p.F[6 + i]);
    const T a = S[3] + S[5], b = S[0] + S[5], c = S[0] + S[3];
    T K[6] = {b * c - S[4] * S[4], S[1] * c + S[2] * S[4], S[2] * b + S[1] * S[4],
              a * c - S[2] * S[2], S[4] * a + S[1] * S[2], a * b - S[1] * S[1]};
    // Two stretches that are each other's negative: the nearest rotation is not unique, and its
    // derivative unbounded.
    const T det = max(a * K[0] - S[1] * K[1] - S[2] * K[2], broadcast<T>(1e-12));
    const T turn = (w[1] * p.trace - w[0]) / det;
    for (int m = 0; m < 6; ++m) K[m] = turn * K[m];
    T Y[9][3];  // for entry (k, l) of F
    for (int k = 0; k < 3; ++k)
      for (int l = 0; l < 3; ++l) {
        const int n = (l + 1) % 3, o = (l + 2) % 3;  // (R e_n)_kl = R_ko, (R e_o)_kl = -R_kn
        for (int m = 0; m < 3; ++m)
          Y[3 * k + l][m] = K[sixth(m, n)] * R[3 * k + o] - K[sixth(m, o)] * R[3 * k + n];
      }
    T volume[9];
    for (int i = 0; i < 9; ++i) volume[i] = w[1] * R[i];
    for_upper([&](int i, int j, int k, int l) {
      const int m = (j + 1) % 3, o = (j + 2) % 3;
      const T* y = Y[3 * k + l];
      T h = volume[3 * i + j] * R[3 * k + l] + R[3 * i + o] * y[m] - R[3 * i + m] * y[o];
      if (i == k && j == l) h += w[0];
      H[9 * (3 * i + j) + 3 * k + l] = h;
    });
  }

  template <class T>
  static void jets(const PrincipalFrame<T>& p, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
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
  static constexpr bool kKeepsSamples = false, kJetsInFrame = false;

  template <class T>
  using Sample = VolumeSample<T>;

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T P[9]) {
    const T mu = 0.5 * w[0], l = w[1] + (5.0 / 6.0) * mu;
    const T u = 0.5 * p.trace;                                       // (I - 3)/4
    const T stiffness = mu * ((1.0 + (4.0 / 3.0) * u) / (1.0 + u));  // m (1 - 1/(I + 1))
    const T pressure = l * p.growth - mu;
    for (int i = 0; i < 9; ++i) P[i] = stiffness * p.F[i] + pressure * p.cofactor[i];
    return mu * (p.excess + (2.0 / 3.0) * log_gap(u)) + 0.5 * l * p.growth * p.growth;
  }

  template <class T>
  static void tangent(const Sample<T>& p, const T w[kWeights], T H[81]) {
    const T mu = 0.5 * w[0], l = w[1] + (5.0 / 6.0) * mu;
    const T inverse = 1.0 / (4.0 + 2.0 * p.trace);           // 1/(I + 1)
    const T stiffness = (4.0 / 3.0) * mu * (1.0 - inverse);  // m (1 - 1/(I + 1))
    const T bend = (8.0 / 3.0) * mu * inverse * inverse;
    const T pressure = l * p.growth - mu;  // dpsi/dJ
    T bent[9], grown[9], pressed[9];
    for (int i = 0; i < 9; ++i) {
      bent[i] = bend * p.F[i];
      grown[i] = l * p.cofactor[i];
      pressed[i] = pressure * p.F[i];
    }
    for_upper([&](int i, int j, int k, int l) {
      const int a = 3 * i + j, b = 3 * k + l;
      T h = bent[a] * p.F[b] + grown[a] * p.cofactor[b];
      if (a == b) h += stiffness;
      if (i != k && j != l) {  // pressure times the derivative of the cofactors
        const T& other = pressed[3 * third(i, k) + third(j, l)];
        h = ((k - i + 3) % 3 == 1) == ((l - j + 3) % 3 == 1) ? h + other : h - other;
      }
      H[9 * a + b] = h;
    });
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
  static constexpr bool kKeepsSamples = false, kJetsInFrame = false;

  template <class T>
  using Sample = LogSample<T>;

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T P[9]) {
    const T mu = 0.5 * w[0], pressure = w[1] * p.log_J - mu;
    for (int i = 0; i < 9; ++i) P[i] = mu * p.F[i] + pressure * p.inverse[i];
    return p.where_upright(mu * p.gap + 0.5 * w[1] * p.log_J * p.log_J);
  }

  template <class T>
  static void tangent(const Sample<T>& p, const T w[kWeights], T H[81]) {
    const T mu = 0.5 * w[0], pressure = w[1] * p.log_J - mu;
    T volume[9], pressed[9];
    for (int i = 0; i < 9; ++i)
      volume[i] = w[1] * p.inverse[i], pressed[i] = pressure * p.inverse[i];
    for_upper([&](int i, int j, int k, int l) {
      T h = volume[3 * i + j] * p.inverse[3 * k + l] - pressed[3 * i + l] * p.inverse[3 * k + j];
      if (i == k && j == l) h += mu;
      H[9 * (3 * i + j) + 3 * k + l] = h;
    });
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
  static constexpr bool kKeepsSamples = false, kJetsInFrame = false;

  template <class T>
  using Sample = StrainSample<T>;

  /// w[0] E + w[1] tr(E) 1.
  template <class T>
  static void second_stress(const Sample<T>& p, const T w[kWeights], T S[6]) {
    const T pressure = w[1] * p.trace;
    for (int i = 0; i < 6; ++i) S[i] = w[0] * p.E[i];
    S[0] += pressure, S[3] += pressure, S[5] += pressure;
  }

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T P[9]) {
    T S[6];
    second_stress(p, w, S);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        P[3 * i + j] = p.F[3 * i] * S[sixth(0, j)] + p.F[3 * i + 1] * S[sixth(1, j)] +
                       p.F[3 * i + 2] * S[sixth(2, j)];
    return 0.5 * (w[0] * p.square() + w[1] * p.trace * p.trace);
  }

  template <class T>
  static void tangent(const Sample<T>& p, const T w[kWeights], T H[81]) {
    const T* F = p.F;
    const T half = 0.5 * w[0];
    T S[6], halved[9], volume[9], B[6];
    second_stress(p, w, S);
    for (int i = 0; i < 9; ++i) halved[i] = half * F[i], volume[i] = w[1] * F[i];
    for (int i = 0; i < 3; ++i)
      for (int k = i; k < 3; ++k)
        B[sixth(i, k)] = halved[3 * i] * F[3 * k] + halved[3 * i + 1] * F[3 * k + 1] +
                         halved[3 * i + 2] * F[3 * k + 2];
    for_upper([&](int i, int j, int k, int l) {
      T h = volume[3 * i + j] * F[3 * k + l] + halved[3 * i + l] * F[3 * k + j];
      if (i == k) h += S[sixth(j, l)];
      if (j == l) h += B[sixth(i, k)];
      H[9 * (3 * i + j) + 3 * k + l] = h;
    });
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
  static constexpr bool kKeepsSamples = false, kJetsInFrame = false;

  template <class T>
  using Sample = LogSample<T>;

  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T P[9]) {
    const T psi = NeoHookeanMaterial::stress(p, w, P);
    // (I F - F F^T F)/2 = F (1 + tr E - E), and F^-T (1 + ln J) off it
    const T trace = 1.0 + p.trace, back = w[2] * (1.0 + p.log_J);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        const T* row = p.F + 3 * i;
        const T FE =
            row[0] * p.E[sixth(0, j)] + row[1] * p.E[sixth(1, j)] + row[2] * p.E[sixth(2, j)];
        P[3 * i + j] += w[2] * (trace * row[j] - FE) - back * p.inverse[3 * i + j];
      }
    return p.where_upright(psi + w[2] * (p.gap + p.minors - 0.5 * p.log_J * p.log_J));
  }

  template <class T>
  static void tangent(const Sample<T>& p, const T w[kWeights], T H[81]) {
    NeoHookeanMaterial::tangent(p, w, H);
    const T *F = p.F, *D = p.inverse;
    const T half = 0.5 * w[2], back = w[2] * (1.0 + p.log_J);
    const T square = half * (3.0 + 2.0 * p.trace);  // half of I
    T B[6], right[6];                               // halves of F F^T and F^T F
    for (int i = 0; i < 3; ++i)
      for (int k = i; k < 3; ++k) {
        B[sixth(i, k)] = half * (F[3 * i] * F[3 * k] + F[3 * i + 1] * F[3 * k + 1] +
                                 F[3 * i + 2] * F[3 * k + 2]);
        right[sixth(i, k)] = w[2] * p.E[sixth(i, k)] + (i == k ? half : broadcast<T>(0.0));
      }
    for_upper([&](int i, int j, int k, int l) {
      const int a = 3 * i + j, b = 3 * k + l, c = 3 * i + l, d = 3 * k + j;
      T h = w[2] * (F[a] * F[b] - D[a] * D[b]) - half * F[c] * F[d] + back * D[c] * D[d];
      if (i == k) h -= right[sixth(j, l)];
      if (j == l) h -= B[sixth(i, k)];
      if (a == b) h += square;
      H[9 * a + b] += h;
    });
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
