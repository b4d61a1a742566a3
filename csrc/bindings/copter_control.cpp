// Hover thrusts, Lyapunov and Riccati equations; diffsim/copter/_ops_*.py check the arguments.
#include <Eigen/Core>

#include "bindings/bindings.h"
#include "kernels/copter/hover.h"
#include "kernels/copter/riccati.h"
#include "kernels/parallel.h"

namespace diffsim {
namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

Eigen::MatrixXd matrix(Address a, std::int64_t index, std::int64_t rows) {
  return Eigen::Map<const RowMajor>(in(a) + index * rows * rows, rows, rows);
}

void store(const Eigen::MatrixXd& X, Address a, std::int64_t index, std::int64_t rows) {
  Eigen::Map<RowMajor>(out(a) + index * rows * rows, rows, rows) = X;
}

/// Problem `index` of a batch stored one after the other.
HoverProblem hover_problem(Address force, Address torque, Address weights, Address upper,
                           double barrier, int num_rotors, std::int64_t index) {
  return {num_rotors,
          in(force) + index * 3 * num_rotors,
          in(torque) + index * 3 * num_rotors,
          in(weights) + index * num_rotors,
          in(upper) + index * num_rotors,
          barrier};
}

}  // namespace

void bind_copter_control(nb::module_& m) {
  m.def("hover", [](Address force, Address torque, Address weights, Address upper, double barrier,
                    std::int64_t batch, int n, Address u, Address multipliers, Address state,
                    Address info, int num_threads) {
    nb::gil_scoped_release release;
    ThreadPool pool(num_threads);
    pool.run(batch, [&](std::int64_t b) {
      solve_hover(hover_problem(force, torque, weights, upper, barrier, n, b), out(u) + b * n,
                  out(multipliers) + b * 4, out_index(state) + b * n,
                  out_index(info) + b * kHoverInfo);
    });
  });
  m.def("hover_vjp",
        [](Address force, Address torque, Address weights, Address upper, double barrier,
           std::int64_t batch, int n, Address u, Address multipliers, Address state, Address info,
           Address grad_u, Address grad_force, Address grad_torque, Address grad_weights,
           Address grad_upper, int num_threads) {
          nb::gil_scoped_release release;
          ThreadPool pool(num_threads);
          pool.run(batch, [&](std::int64_t b) {
            solve_hover_vjp(hover_problem(force, torque, weights, upper, barrier, n, b),
                            in(u) + b * n, in(multipliers) + b * 4, in_index(state) + b * n,
                            in_index(info) + b * kHoverInfo, in(grad_u) + b * n,
                            out(grad_force) + b * 3 * n, out(grad_torque) + b * 3 * n,
                            out(grad_weights) + b * n, out(grad_upper) + b * n);
          });
        });
  m.def("lyapunov", [](Address A, Address Q, std::int64_t batch, std::int64_t n, Address X,
                       Address solved, int num_threads) {
    nb::gil_scoped_release release;
    ThreadPool pool(num_threads);
    pool.run(batch, [&](std::int64_t b) {
      Eigen::MatrixXd solution = Eigen::MatrixXd::Zero(n, n);
      out_index(solved)[b] = solve_lyapunov(matrix(A, b, n), matrix(Q, b, n), solution);
      store(solution, X, b, n);
    });
  });
  m.def("care", [](Address A, Address G, Address Q, std::int64_t batch, std::int64_t n, Address P,
                   Address report, int num_threads) {
    nb::gil_scoped_release release;
    ThreadPool pool(num_threads);
    pool.run(batch, [&](std::int64_t b) {
      Eigen::MatrixXd solution;
      const CareReport r = solve_care(matrix(A, b, n), matrix(G, b, n), matrix(Q, b, n), solution);
      store(solution, P, b, n);
      double* row = out(report) + b * 4;
      row[0] = r.solved;
      row[1] = r.num_iters;
      row[2] = r.residual;
      row[3] = r.abscissa;
    });
  });
}

}  // namespace diffsim
