#include "kernels/copter/hover.h"
#include "kernels/copter/hover_system.h"

namespace diffsim {

using namespace hover_system;

// With the free rotors' conditions z_F(u, y; design) = 0 and c(u; design) = delta y, the adjoint
// solves K (v, w) = (dL/du_F, 0), and dL/d(design) = -d/d(design) of
//   v' z_F + w' c,  z = h u + dc/du' y + barrier.
void solve_hover_vjp(const HoverProblem& problem, const double* u, const double* multipliers,
                     const std::int64_t* state, const std::int64_t* info, const double* grad_u,
                     double* grad_force, double* grad_torque, double* grad_weights,
                     double* grad_upper) {
  const View p(problem);
  Iterate at;
  at.u = Eigen::Map<const VectorXd>(u, p.n);
  at.y = Eigen::Map<const Vector4d>(multipliers);
  for (int i = 0; i < p.n; ++i) at.state.push_back(static_cast<BoundState>(state[i]));
  at.feasible = info[0] != static_cast<std::int64_t>(HoverStatus::kInfeasible);
  const Eigen::Map<const VectorXd> g(grad_u, p.n);
  Eigen::Map<Rows3> gF(grad_force, 3, p.n), gT(grad_torque, 3, p.n);
  Eigen::Map<VectorXd> gh(grad_weights, p.n), gup(grad_upper, p.n);
  gF.setZero();
  gT.setZero();
  gh.setZero();
  gup.setZero();
  const Vector3d f = p.F * at.u;
  const double lift = f.norm();
  if (!(lift > 0.0)) return;
  const Vector3d a = f / lift;
  const std::vector<int> free = free_rotors(at.state);
  const int m = static_cast<int>(free.size());
  VectorXd rhs = VectorXd::Zero(m + 4);
  rhs.head(m) = g(free);
  const VectorXd adjoint = pseudo_solve(kkt_matrix(p, at, free), rhs);
  VectorXd v = VectorXd::Zero(p.n);
  for (int k = 0; k < m; ++k) v[free[k]] = adjoint[k];
  const Vector4d w = adjoint.tail<4>();
  const MatrixXd turn = turning(p, a);
  gF = -(at.y[0] * (a * v.transpose() + turn * v / lift * at.u.transpose()) +
         w[0] * a * at.u.transpose());
  gT = -(at.y.tail<3>() * v.transpose() + w.tail<3>() * at.u.transpose());
  gh = -v.cwiseProduct(at.u);
  const VectorXd coupling =
      at.y[0] / lift * turn.transpose() * (turn * v) + jacobian(p, a).transpose() * w;
  for (int i = 0; i < p.n; ++i) {
    if (at.state[i] == BoundState::kUpper) gup[i] = g[i] - coupling[i];
    if (p.barrier > 0.0) {
      const double room = p.upper[i] - at.u[i];
      gup[i] = v[i] * p.barrier / (room * room);
    }
  }
}

}  // namespace diffsim
