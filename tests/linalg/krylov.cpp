// Krylov solvers on matrices that no step of a body leads to: exact spectra, indefinite ones,
// unsymmetric ones, restarts. Prints "right", or what is not.
#include "kernels/linalg/krylov.h"

#include <cmath>
#include <cstdio>
#include <cstdlib>

#include "kernels/linalg/flexible_gmres.h"

using diffsim::KrylovResult;
using diffsim::KrylovScratch;
using diffsim::ThreadPool;
using diffsim::Vector;
using diffsim::VectorOps;

namespace {

double mistake = 0.0;  // added to an off-diagonal entry of the products

void require(bool holds, const char* what) {
  if (holds) return;
  std::printf("wrong: %s\n", what);
  std::exit(1);
}

/// A tridiagonal matrix: `diagonal` by row, `below` and `above` it.
struct Tridiagonal {
  Vector diagonal;
  double below, above;

  void operator()(const Vector& in, Vector& out) const {
    const std::size_t n = diagonal.size();
    out.resize(n);
    for (std::size_t i = 0; i < n; ++i) {
      out[i] = diagonal[i] * in[i];
      if (i > 0) out[i] += (below + mistake) * in[i - 1];
      if (i + 1 < n) out[i] += above * in[i + 1];
    }
  }
};

void identity(const Vector& in, Vector& out) { out = in; }

Vector ramp(std::size_t n) {
  Vector v(n);
  for (std::size_t i = 0; i < n; ++i) v[i] = 1.0 + 0.1 * static_cast<double>(i % 7);
  return v;
}

/// Residual of a solution against an independent product with the matrix.
double residual(const Tridiagonal& A, const Vector& x, const Vector& b) {
  double total = 0.0;
  for (std::size_t i = 0; i < b.size(); ++i) {
    double row = A.diagonal[i] * x[i] - b[i];
    if (i > 0) row += A.below * x[i - 1];
    if (i + 1 < b.size()) row += A.above * x[i + 1];
    total += row * row;
  }
  return std::sqrt(total);
}

void conjugate_gradients(VectorOps& ops) {
  KrylovScratch scratch;
  Vector x, diagonal(300, 1.0);
  for (std::size_t i = 0; i < diagonal.size(); ++i) diagonal[i] = static_cast<double>(1 + i % 5);
  const Vector b = ramp(diagonal.size());
  const Tridiagonal five{diagonal, 0.0, 0.0};  // five eigenvalues: exact after five iterations
  KrylovResult r =
      diffsim::conjugate_gradients(five, identity, b, x, false, 1e-10, 100, scratch, ops);
  require(r.converged && r.num_iters == 5, "five eigenvalues take five iterations");
  require(residual(five, x, b) < 1e-9, "the residual is that of the answer");
  r = diffsim::conjugate_gradients(five, identity, b, x, true, 1e-9, 100, scratch, ops);
  require(r.converged && r.num_iters == 0, "a warm start at the answer takes none");

  diagonal[17] = -3.0;
  const Tridiagonal saddle{diagonal, 0.0, 0.0};
  r = diffsim::conjugate_gradients(saddle, identity, b, x, false, 1e-10, 100, scratch, ops);
  require(r.negative_curvature && !r.converged, "negative curvature is met");
  require(ops.dot(b, x) > 0.0, "and what it returns descends");
}

void minres(VectorOps& ops) {
  Vector diagonal(200), x;
  for (std::size_t i = 0; i < diagonal.size(); ++i) diagonal[i] = i % 3 == 0 ? -2.5 : 3.0;
  const Tridiagonal saddle{diagonal, 0.4, 0.4};
  const Vector b = ramp(diagonal.size());
  const KrylovResult r = diffsim::minres(saddle, identity, b, x, 1e-10, 400, ops);
  require(r.converged && residual(saddle, x, b) < 2e-10, "minres solves an indefinite matrix");
}

void gmres(VectorOps& ops) {
  Vector diagonal(400), x;
  for (std::size_t i = 0; i < diagonal.size(); ++i)
    diagonal[i] = 2.0 + 0.01 * static_cast<double>(i);
  const Tridiagonal sheared{diagonal, 0.9, -0.7};
  const Vector b = ramp(diagonal.size());
  KrylovResult r =
      diffsim::flexible_gmres<double>(sheared, identity, b, x, false, 1e-9, 1000, 60, ops);
  require(r.converged && residual(sheared, x, b) < 2e-9, "gmres solves an unsymmetric matrix");
  require(std::abs(r.residual_norm - residual(sheared, x, b)) < 1e-12, "and knows its residual");
  // From near the answer it takes fewer iterations; a guess worse than zero is not taken.
  const int cold = r.num_iters;
  for (double& value : x) value *= 1.0 + 1e-6;
  r = diffsim::flexible_gmres<double>(sheared, identity, b, x, true, 1e-9, 1000, 60, ops);
  require(r.converged && residual(sheared, x, b) < 2e-9, "gmres begins at a guess");
  require(2 * r.num_iters < cold, "and gains by it");
  for (double& value : x) value *= -9.0;
  r = diffsim::flexible_gmres<double>(sheared, identity, b, x, true, 1e-9, 1000, 60, ops);
  require(r.converged && r.num_iters == cold, "and leaves one that is worse than none");
  // A preconditioner that rounds to single precision, and by another share at every call.
  int calls = 0;
  const auto varying = [&](const Vector& in, Vector& out) {
    out.resize(in.size());
    const double share = ++calls % 2 ? 1.1 : 0.9;
    for (std::size_t i = 0; i < in.size(); ++i)
      out[i] = static_cast<double>(static_cast<float>(share * in[i] / diagonal[i]));
  };
  r = diffsim::flexible_gmres<float>(sheared, varying, b, x, false, 1e-9, 1000, 60, ops);
  require(r.converged && residual(sheared, x, b) < 2e-9, "and bears a preconditioner that varies");
  require(std::abs(r.residual_norm - residual(sheared, x, b)) < 1e-12, "whose residual it knows");
  // A cyclic shift: nothing is gained before the last iteration, so restarts gain nothing at all.
  const auto shift = [](const Vector& in, Vector& out) {
    out.resize(in.size());
    for (std::size_t i = 0; i < in.size(); ++i) out[(i + 1) % in.size()] = in[i];
  };
  Vector first(100, 0.0);
  first[0] = 1.0;
  r = diffsim::flexible_gmres<double>(shift, identity, first, x, false, 1e-9, 1000, 60, ops);
  require(!r.converged && r.num_iters <= 60, "restarts that gain nothing end");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc > 1) mistake = std::atof(argv[1]);
  ThreadPool pool(1);
  VectorOps ops(pool);
  conjugate_gradients(ops);
  minres(ops);
  gmres(ops);
  std::printf("right\n");
}
