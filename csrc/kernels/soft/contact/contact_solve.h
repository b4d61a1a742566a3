// Linear solves on the unknowns that contact leaves free.
#pragma once

#include "kernels/soft/contact/contact_preconditioner.h"

namespace diffsim {

/// Which way a linear system is read.
enum class LinearSide { kForward, kTransposed };

class ContactSolve {
 public:
  ContactSolve(StepProblem& problem, const ConstantSystem& system, const ContactSpace& space,
               StepMethod method, double rtol, bool cache_columns, ThreadPool& pool);

  /// The statuses or the assembled H changed. On the constant factor a new H alone costs nothing;
  /// multigrid takes it over by itself. A factor of the tangent serves one set of contacts: what
  /// it costs is weighed against the iterations on this set.
  void statuses_changed() {
    stale_statuses_ = true;
    spent_ = 0;
  }
  /// Some contacts stick that slid. A factor of the tangent made before serves on.
  void contacts_stopped() {
    if (!preconditioner_.on_tangent()) statuses_changed();
  }
  void matrix_changed(bool is_clamped) {
    stale_matrix_ = true;
    is_clamped_ = is_clamped;
  }

  /// Whether the next solve is on multigrid, whose errors hold rigid motion.
  bool on_multigrid() {
    choose();
    return kind_ == Kind::kBase && problem_.by_multigrid();
  }

  /// q in the range of P with [P H + mu t (n . H) + D] q = r, r in the range of P.
  /// @param is_guess  whether q is a first guess, in the range of P: GMRES may begin there
  KrylovResult solve(const Vector& r, double tolerance, int max_iters, bool is_guess, Vector& q);
  /// The same, or its transpose: p with P H (p + mu (t . p) n) + D p = r, at an answer x of a step,
  /// where H may be indefinite: what fails is solved again on a factor of the clamped tangent.
  KrylovResult solve_answer(const Vector& x, LinearSide side, const Vector& r, double tolerance,
                            int max_iters, Vector& out);
  /// Whether solves on multigrid have come to need a factor for each set of statuses.
  bool factors_each_set() const { return kind_ == Kind::kTangent && problem_.by_multigrid(); }
  /// A factor of the tangent from here on.
  void use_tangent() { kind_ = Kind::kTangent; }

 private:
  enum class Kind { kBase, kTangent, kJacobi };
  void choose();
  /// Iterations without a factor of the tangent after which one would have been cheaper.
  int patience() const;
  /// Expected of a step, or of one solve at an answer, by those at rest.
  double iterations(double at_rest) const;
  void prepare();
  /// out = H in; notes where H has negative curvature, if iterations on it may be given up.
  void multiply(const Vector& in, Vector& out);
  /// Whether iterations are those of GMRES on multigrid.
  bool may_give_up() const;
  /// Whether so many iterations on multigrid left so much of the first residual that no answer is
  /// near: those on an indefinite or a clamped H either soon converge or never.
  bool is_hopeless(int iterations, double left) const;
  void apply(const Vector& in, Vector& out);
  void apply_transposed(const Vector& in, Vector& out);
  void precondition(const Vector& in, Vector& out);
  template <typename Apply>
  KrylovResult iterate(Apply&& apply, const Vector& r, double tolerance, int max_iters,
                       bool is_guess, Vector& q);

  StepProblem& problem_;
  const ConstantSystem& system_;
  const ContactSpace& space_;
  StepMethod method_;
  double rtol_;
  Kind kind_ = Kind::kBase;
  bool at_answer_ = false, is_clamped_ = false, is_indefinite_ = false;
  bool stale_statuses_ = true, stale_matrix_ = true;
  int age_ = 0, spent_ = 0;  // iterations on this factor of the tangent; on others
  ContactPreconditioner preconditioner_;
  KrylovScratch krylov_;
  Vector expanded_;
};

}  // namespace diffsim
