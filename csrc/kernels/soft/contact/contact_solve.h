// Linear solves on the unknowns that contact leaves free.
#pragma once

#include "kernels/soft/contact/contact_preconditioner.h"

namespace diffsim {

class ContactSolve {
 public:
  ContactSolve(StepProblem& problem, const ConstantSystem& system, const ContactSpace& space,
               StepMethod method, double rtol, bool cache_columns, ThreadPool& pool);

  /// The statuses or the assembled H changed. On the constant factor a new H alone costs nothing.
  void statuses_changed() { stale_statuses_ = true; }
  void matrix_changed() { stale_matrix_ = true; }

  /// q in the range of P with [P H + mu t (n . H) + D] q = r, r in the range of P.
  KrylovResult solve(const Vector& r, double tolerance, int max_iters, Vector& q);
  /// The transpose: p with P H (p + mu (t . p) n) + D p = r.
  KrylovResult solve_transposed(const Vector& r, double tolerance, int max_iters, Vector& p);
  /// Both where H may be indefinite, on a factor made by `prepare_tangent`.
  KrylovResult solve_indefinite(const Vector& r, double tolerance, int max_iters, Vector& q);
  KrylovResult solve_indefinite_transposed(const Vector& r, double tolerance, int max_iters,
                                           Vector& p);
  /// A factor of the tangent from here on.
  void use_tangent() { kind_ = Kind::kTangent; }
  /// Preconditions by the factor of this tangent, whatever H is assembled later.
  bool prepare_tangent();

 private:
  enum class Kind { kConstant, kTangent, kJacobi };
  void choose();
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
  Kind kind_ = Kind::kConstant;
  bool stale_statuses_ = true, stale_matrix_ = true;
  int age_ = 0, spent_ = 0;  // iterations on this factor of the tangent; on the constant one
  ContactPreconditioner preconditioner_;
  KrylovScratch krylov_;
  Vector expanded_;
};

}  // namespace diffsim
