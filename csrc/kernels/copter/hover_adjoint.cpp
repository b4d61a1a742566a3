#include "kernels/copter/hover.h"
#include "kernels/copter/hover_system.h"

namespace diffsim {

using namespace hover_system;

namespace {

/// The result of solve_hover, and what both derivatives need of it.
struct Solved {
  Solved(const View& p, const double* u, const double* multipliers, const std::int64_t* state,
         const std::int64_t* info) {
    at.u = Eigen::Map<const VectorXd>(u, p.n);
    at.y = Eigen::Map<const Vector4d>(multipliers);
    for (int i = 0; i < p.n; ++i) at.state.push_back(static_cast<BoundState>(state[i]));
    at.feasible = info[0] != static_cast<std::int64_t>(HoverStatus::kInfeasible);
    const Vector3d f = p.F * at.u;
    lift = f.norm();
    if (lift > 0.0) a = f / lift;
    free = free_rotors(at.state);
  }
  Iterate at;
  double lift = 0.0;
  Vector3d a = Vector3d::Zero();
  std::vector<int> free;
};

}  // namespace

// With the free rotors' conditions z_F(u, y; design) = 0 and c(u; design) = delta y, the adjoint
// solves K (v, w) = (dL/du_F, 0), and dL/d(design) = -d/d(design) of
//   v' z_F + w' c,  z = h u + dc/du' y + barrier.
void solve_hover_vjp(const HoverProblem& problem, const double* u, const double* multipliers,
                     const std::int64_t* state, const std::int64_t* info, const double* grad_u,
                     double* grad_force, double* grad_torque, double* grad_weights,
                     double* grad_upper) {
  const View p(problem);
  const Solved solved(p, u, multipliers, state, info);
  const Iterate& at = solved.at;
  const Eigen::Map<const VectorXd> g(grad_u, p.n);
  Eigen::Map<Rows3> gF(grad_force, 3, p.n), gT(grad_torque, 3, p.n);
  Eigen::Map<VectorXd> gh(grad_weights, p.n), gup(grad_upper, p.n);
  gF.setZero();
  gT.setZero();
  gh.setZero();
  gup.setZero();
  if (!(solved.lift > 0.0)) return;
  const double lift = solved.lift;
  const Vector3d& a = solved.a;
  const std::vector<int>& free = solved.free;
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

// K (du_F, dy) = -(dz_F, dc) for what the direction does to z and c, read off the adjoint above.
void solve_hover_tangent(const HoverProblem& problem, const double* u, const double* multipliers,
                         const std::int64_t* state, const std::int64_t* info,
                         const HoverDirection& direction, double* du_out) {
  const View p(problem);
  const Solved solved(p, u, multipliers, state, info);
  const Iterate& at = solved.at;
  Eigen::Map<VectorXd> du(du_out, p.n);
  du.setZero();
  if (!(solved.lift > 0.0)) return;
  const Vector3d& a = solved.a;
  const Eigen::Map<const Rows3> dF(direction.force, 3, p.n), dT(direction.torque, 3, p.n);
  const Eigen::Map<const VectorXd> dh(direction.weights, p.n), dup(direction.upper, p.n);
  const MatrixXd turn = turning(p, a);
  if (!(p.barrier > 0.0))
    for (int i = 0; i < p.n; ++i)
      if (at.state[i] == BoundState::kUpper) du[i] = dup[i];
  const Vector3d moved = dF * at.u, twisted = dT * at.u;
  VectorXd z = at.y[0] * (dF.transpose() * a + turn.transpose() * moved / solved.lift) +
               dT.transpose() * at.y.tail<3>() + dh.cwiseProduct(at.u) +
               at.y[0] / solved.lift * turn.transpose() * (turn * du);
  Vector4d c = jacobian(p, a) * du;
  c[0] += a.dot(moved);
  c.tail<3>() += twisted;
  if (p.barrier > 0.0) {
    const VectorXd room = p.upper - at.u;
    z -= p.barrier * dup.cwiseQuotient(room.cwiseProduct(room));
  }
  const int m = static_cast<int>(solved.free.size());
  VectorXd rhs(m + 4);
  rhs.head(m) = -z(solved.free);
  rhs.tail<4>() = -c;
  const VectorXd step = pseudo_solve(kkt_matrix(p, at, solved.free), rhs);
  for (int k = 0; k < m; ++k) du[solved.free[k]] = step[k];
}

}  // namespace diffsim
