// Conjugate gradients on one tangent: our multigrid and AMGCL's smoothed aggregation, in turn.
//
// Built and called by studies/soft_amgcl.py. Both precondition in float32 and stop at the same
// residual; the products of the iteration itself are a plain loop in ours.
#include <algorithm>
#include <amgcl/adapter/block_matrix.hpp>
#include <amgcl/adapter/crs_tuple.hpp>
#include <amgcl/amg.hpp>
#include <amgcl/backend/builtin.hpp>
#include <amgcl/coarsening/as_scalar.hpp>
#include <amgcl/coarsening/rigid_body_modes.hpp>
#include <amgcl/coarsening/smoothed_aggregation.hpp>
#include <amgcl/make_block_solver.hpp>
#include <amgcl/make_solver.hpp>
#include <amgcl/relaxation/chebyshev.hpp>
#include <amgcl/relaxation/ilu0.hpp>
#include <amgcl/relaxation/spai0.hpp>
#include <amgcl/solver/cg.hpp>
#include <amgcl/value_type/static_matrix.hpp>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <random>
#include <stdexcept>

#include "kernels/linalg/krylov.h"
#include "kernels/linalg/rigid_multigrid.h"

namespace {

using diffsim::Vector;
using Index = std::int64_t;
constexpr double kTolerance = 1e-6;  // of the residual over the right-hand side
constexpr int kMaxIters = 300;
constexpr int kRepetitions = 3;  // the median is printed
constexpr Index kLanes = 8;      // rows of strips are whole vectors

double cpu_seconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

struct Tangent {
  Index num_nodes = 0;
  diffsim::Pattern pattern;
  std::vector<double> blocks;   // (entries, 3, 3)
  std::vector<double> inertia;  // (num_nodes,) added to the diagonal
  std::vector<std::uint8_t> fixed;
  std::vector<double> x;

  explicit Tangent(const char* path) : file_(path, std::ios::binary) {
    std::vector<Index> sizes(2);
    read(sizes, 2);
    num_nodes = sizes[0];
    const auto n = static_cast<std::size_t>(num_nodes),
               entries = static_cast<std::size_t>(sizes[1]);
    read(pattern.row_start, n + 1);
    read(pattern.column, entries);
    read(blocks, 9 * entries);
    read(inertia, n);
    read(fixed, 3 * n);
    read(x, 3 * n);
  }

  /// Entry of the elastic part; fixed unknowns have a row of the identity.
  double operator()(Index i, Index entry, int a, int b) const {
    const Index j = pattern[entry];
    if (fixed[static_cast<std::size_t>(3 * i + a)] || fixed[static_cast<std::size_t>(3 * j + b)])
      return i == j && a == b ? 1.0 : 0.0;
    return blocks[static_cast<std::size_t>(9 * entry + 3 * a + b)];
  }

 private:
  template <typename T>
  void read(std::vector<T>& values, std::size_t count) {
    values.resize(count);
    file_.read(reinterpret_cast<char*>(values.data()),
               static_cast<std::streamsize>(count * sizeof(T)));
    if (!file_) throw std::runtime_error("the tangent's file ends early");
  }
  std::ifstream file_;
};

struct Rows {  // compressed, inertia included
  std::vector<std::ptrdiff_t> start{0}, column;
  std::vector<double> value;

  explicit Rows(const Tangent& t) {
    for (Index i = 0; i < t.num_nodes; ++i)
      for (int a = 0; a < 3; ++a) {
        for (Index e = t.pattern.begin(i); e < t.pattern.end(i); ++e)
          for (int b = 0; b < 3; ++b) {
            const bool diagonal = t.pattern[e] == i && a == b;
            column.push_back(3 * t.pattern[e] + b);
            value.push_back(t(i, e, a, b) +
                            (diagonal ? t.inertia[static_cast<std::size_t>(i)] : 0.0));
          }
        start.push_back(static_cast<std::ptrdiff_t>(column.size()));
      }
  }
  void multiply(const Vector& in, Vector& out) const {
    out.resize(in.size());
    for (std::size_t i = 0; i + 1 < start.size(); ++i) {
      double sum = 0.0;
      for (auto e = start[i]; e < start[i + 1]; ++e)
        sum += value[static_cast<std::size_t>(e)] *
               in[static_cast<std::size_t>(column[static_cast<std::size_t>(e)])];
      out[i] = sum;
    }
  }
};

struct Times {
  double prepare, solve;
  int iters;
  double residual;
};

void print(const char* name, std::vector<Times> runs) {
  std::sort(runs.begin(), runs.end(), [](const Times& a, const Times& b) {
    return a.prepare + a.solve < b.prepare + b.solve;
  });
  const Times& t = runs[runs.size() / 2];
  std::printf("| %s | %.1f | %.1f | %d | %.1e |\n", name, 1e3 * t.prepare, 1e3 * t.solve, t.iters,
              t.residual);
  std::fflush(stdout);
}

void ours(const Tangent& t, const Rows& rows, const Vector& b) {
  std::vector<Index> start{0};
  for (Index i = 0; i < t.num_nodes; ++i) {
    const Index width = 3 * (t.pattern.end(i) - t.pattern.begin(i));
    start.push_back(start.back() + 3 * ((width + kLanes - 1) / kLanes * kLanes));
  }
  std::vector<double> strips(static_cast<std::size_t>(start.back()), 0.0);
  for (Index i = 0; i < t.num_nodes; ++i) {
    const Index begin = start[static_cast<std::size_t>(i)];
    const Index width = (start[static_cast<std::size_t>(i + 1)] - begin) / 3;
    for (Index e = t.pattern.begin(i); e < t.pattern.end(i); ++e)
      for (int a = 0; a < 3; ++a)
        for (int k = 0; k < 3; ++k)
          strips[static_cast<std::size_t>(begin + a * width + 3 * (e - t.pattern.begin(i)) + k)] =
              t(i, e, a, k);
  }
  diffsim::ThreadPool pool(1);
  diffsim::VectorOps ops(pool);
  const auto hierarchy = std::make_shared<const diffsim::RigidHierarchy>(t.pattern);
  diffsim::RigidMultigrid multigrid(hierarchy);
  const diffsim::StripMatrix matrix{t.num_nodes, start.data(), strips.data(), t.inertia.data(),
                                    t.fixed.data()};
  const double norm = ops.norm(b);
  std::vector<Times> runs;
  for (int k = 0; k < kRepetitions; ++k) {
    const double begin = cpu_seconds();
    multigrid.prepare(matrix, t.x.data(), pool);
    const double prepared = cpu_seconds();
    Vector z;
    diffsim::KrylovScratch scratch;
    const auto found = diffsim::conjugate_gradients(
        [&](const Vector& in, Vector& out) { rows.multiply(in, out); },
        [&](const Vector& in, Vector& out) { multigrid.apply(in, out, pool); }, b, z, false,
        kTolerance * norm, kMaxIters, scratch, ops);
    runs.push_back(
        {prepared - begin, cpu_seconds() - prepared, found.num_iters, found.residual_norm / norm});
  }
  print("this project's multigrid", runs);
}

template <typename Solver>
void theirs(const char* name, const Rows& rows, const Vector& b, const std::vector<double>* modes) {
  typename Solver::params options;
  options.solver.tol = kTolerance;
  options.solver.maxiter = kMaxIters;
  if (modes) {
    options.precond.coarsening.nullspace.cols = 6;
    options.precond.coarsening.nullspace.B = *modes;
  }
  const std::ptrdiff_t size = static_cast<std::ptrdiff_t>(b.size());
  const auto matrix = std::tie(size, rows.start, rows.column, rows.value);
  std::vector<Times> runs;
  for (int k = 0; k < kRepetitions; ++k) {
    const double begin = cpu_seconds();
    Solver solver(matrix, options);
    const double prepared = cpu_seconds();
    Vector z(b.size(), 0.0);
    const auto [iters, residual] = solver(b, z);
    runs.push_back({prepared - begin, cpu_seconds() - prepared, static_cast<int>(iters), residual});
  }
  print(name, runs);
}

}  // namespace

int main(int, char** argv) {
  const Tangent tangent(argv[1]);
  const Rows rows(tangent);
  Vector b(static_cast<std::size_t>(3 * tangent.num_nodes));
  std::mt19937 generator(0);
  std::normal_distribution<double> normal;
  for (std::size_t i = 0; i < b.size(); ++i) {
    const double value = normal(generator);
    b[i] = tangent.fixed[i] ? 0.0 : value;
  }
  namespace a = amgcl;
  using Double = a::backend::builtin<double>;
  using Float = a::backend::builtin<float>;
  using Double3 = a::backend::builtin<a::static_matrix<double, 3, 3>>;
  using Float3 = a::backend::builtin<a::static_matrix<float, 3, 3>>;
  std::vector<double> modes;
  a::coarsening::rigid_body_modes(3, tangent.x, modes);
  ours(tangent, rows, b);
  using Plain = a::make_block_solver<
      a::amg<Float3, a::coarsening::smoothed_aggregation, a::relaxation::spai0>,
      a::solver::cg<Double3>>;
  theirs<Plain>("AMGCL, 3x3 blocks, spai0", rows, b, nullptr);
  using Rigid = a::coarsening::as_scalar<a::coarsening::smoothed_aggregation>;
  using Blocks = a::make_block_solver<a::amg<Float3, Rigid::type, a::relaxation::ilu0>,
                                      a::solver::cg<Double3>>;
  theirs<Blocks>("AMGCL, 3x3 blocks, rigid-body modes, ilu0", rows, b, &modes);
  using Spai = a::make_block_solver<a::amg<Float3, Rigid::type, a::relaxation::spai0>,
                                    a::solver::cg<Double3>>;
  theirs<Spai>("AMGCL, 3x3 blocks, rigid-body modes, spai0", rows, b, &modes);
  using Scalar =
      a::make_solver<a::amg<Float, a::coarsening::smoothed_aggregation, a::relaxation::chebyshev>,
                     a::solver::cg<Double>>;
  theirs<Scalar>("AMGCL, scalars, rigid-body modes, Chebyshev", rows, b, &modes);
}
