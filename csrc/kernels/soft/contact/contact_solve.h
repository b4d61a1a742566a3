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
  /// multigrid takes it over by itself.
  void statuses_changed() { stale_statuses_ = true; }
  void matrix_changed() { stale_matrix_ = true; }

  /// Whether the next solve is on multigrid, whose errors hold rigid motion.
  bool on_multigrid() {
    choose();
    return kind_ == Kind::kBase && problem_.by_multigrid();
  }

  /// q in the range of P with [P H + mu t (n . H) + D] q = r, r in the range of P.
  KrylovResult solve(const Vector& r, double tolerance, int max_iters, Vector& q);
  /// The same, or its transpose: p with P H (p + mu (t . p) n) + D p = r, at an answer x of a step,
  /// where H may be indefinite: what fails is solved again on a factor of the clamped tangent.
  KrylovResult solve_answer(const Vector& x, LinearSide side, const Vector& r, double tolerance,
                            int max_iters, Vector& out);
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
  void apply(const Vector& in, Vector& out);
  void apply_transposed(const Vector& in, Vector& out);
  void precondition(const Vector& in, Vector& out);
  template <typename Apply>
  KrylovResult iterate(Apply&& apply, const Vector& r, double tolerance, int max_iters, Vector& q);

  StepProblem& problem_;
  const ConstantSystem& system_;
  const ContactSpace& space_;
  StepMethod method_;
  double rtol_;
  Kind kind_ = Kind::kBase;
  bool at_answer_ = false;
  bool stale_statuses_ = true, stale_matrix_ = true;
  int age_ = 0, spent_ = 0;  // iterations on this factor of the tangent; on others
  ContactPreconditioner preconditioner_;
  KrylovScratch krylov_;
  Vector expanded_;
};

}  // namespace diffsim
