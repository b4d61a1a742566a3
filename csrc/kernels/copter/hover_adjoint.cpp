#include "kernels/copter/hover.h"
#include "kernels/copter/hover_system.h"
#include "kernels/linalg/dense.h"

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
    const Vector3d f = p.net_force(at.u);
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
  rhs.head(m) = entries(g, free);
  const VectorXd adjoint = pseudo_solve(kkt_matrix(p, at, free), rhs);
  VectorXd v = VectorXd::Zero(p.n);
  for (int k = 0; k < m; ++k) v[free[k]] = adjoint[k];
  const Vector4d w = adjoint.tail<4>();
  const MatrixXd turn = turning(p, a);
  const VectorXd turned = dense::apply(turn, v);
  for (int i = 0; i < p.n; ++i)
    for (int k = 0; k < 3; ++k) {
      gF(k, i) = -(at.y[0] * (a[k] * v[i] + turned[k] / lift * at.u[i]) + w[0] * a[k] * at.u[i]);
      gT(k, i) = -(at.y[k + 1] * v[i] + w[k + 1] * at.u[i]);
    }
  gh = -v.cwiseProduct(at.u);
  const VectorXd coupling = at.y[0] / lift * dense::apply_transposed(turn, turned) +
                            dense::apply_transposed(jacobian(p, a), w);
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
  const HoverProblem moving{
      p.n, direction.force, direction.torque, direction.weights, direction.upper, 0.0};
  const View d(moving);
  const MatrixXd turn = turning(p, a);
  if (!(p.barrier > 0.0))
    for (int i = 0; i < p.n; ++i)
      if (at.state[i] == BoundState::kUpper) du[i] = d.upper[i];
  const Vector3d moved = d.net_force(at.u), twisted = d.net_torque(at.u);
  const VectorXd pulled = (moved + dense::apply(turn, du)) * (at.y[0] / solved.lift);
  VectorXd z = dense::apply_transposed(turn, pulled) + d.h.cwiseProduct(at.u);
  for (int i = 0; i < p.n; ++i)
    z[i] +=
        at.y[0] * a.dot(Vector3d(d.F.col(i))) + Vector3d(at.y.tail<3>()).dot(Vector3d(d.T.col(i)));
  Vector4d c = dense::apply(jacobian(p, a), VectorXd(du));
  c[0] += a.dot(moved);
  c.tail<3>() += twisted;
  if (p.barrier > 0.0) {
    const VectorXd room = p.upper - at.u;
    z -= p.barrier * d.upper.cwiseQuotient(room.cwiseProduct(room));
  }
  const int m = static_cast<int>(solved.free.size());
  VectorXd rhs(m + 4);
  rhs.head(m) = -entries(z, solved.free);
  rhs.tail<4>() = -c;
  const VectorXd step = pseudo_solve(kkt_matrix(p, at, solved.free), rhs);
  for (int k = 0; k < m; ++k) du[solved.free[k]] = step[k];
}

}  // namespace diffsim
