// Approximate inverses of P H P + D on the range of P (see contact_space.h).
//
// By multigrid: what contact takes away is taken out of the prolongation and of the smoother
// (rigid_multigrid.h), whatever the number of contacts. Nodes that all but stick are too stiff
// across their slip for its single precision; across they move beside it.
// On the constant factor: with J the directions that contact takes away,
//   z = A^-1 (r - J^T l),   (J A^-1 J^T) l = J A^-1 r,
// is the exact inverse of A on what is left; J A^-1 J^T needs only entries of (A^-1)_CC (thesis
// eqs. 4.32-4.39, Alg. 5, at half the rank). On a factor of the tangent: the blocks of H are
// projected before they are factorized, which costs a factorization for each new contact set,
// whatever its size.
#pragma once

#include <memory>

#include "kernels/soft/contact/contact_space.h"
#include "kernels/soft/rigid_rotations.h"
#include "kernels/soft/step_problem.h"

namespace diffsim {

class ContactPreconditioner {
 public:
  /// @param cache_columns  keep columns of A^-1 with the system; false: solve for them anew for
  ///                       every contact set (only to measure what keeping them is worth)
  ContactPreconditioner(StepProblem& problem, const ConstantSystem& system,
                        const ContactSpace& space, bool cache_columns, ThreadPool& pool)
      : problem_(problem),
        system_(system),
        space_(space),
        cache_columns_(cache_columns),
        pool_(pool) {}

  /// Takes over the space's statuses, on multigrid or on the constant factor as the problem has it.
  void prepare_base();
  /// The same on a factor of the assembled tangent; false where that is not positive definite.
  bool prepare_tangent();
  /// z = approximate inverse times r; r and z lie in the range of P.
  void apply(const Vector& r, Vector& z);

  bool on_tangent() const { return kind_ == Kind::kTangent; }

  /// Modeled seconds of setups and so many iterations, and of a step on factors (solver_plan.h).
  double base_cost(double setups, double iterations) const;
  double tangent_cost() const;

 private:
  enum class Kind { kBase, kTangent };
  double constant_cost(double iterations) const;
  /// One direction taken away at the node of an active contact.
  struct Row {
    std::size_t active;  // index into active_
    double direction[3];
    double compliance;  // [m/N], zero: rigid
  };
  struct Factor;  // Cholesky's; Eigen stays out of what includes this
  /// Rows whose multipliers are coupled.
  struct Group {
    std::vector<Row> rows;
    std::shared_ptr<const Factor> factor;
    int axes = 1;  // 3: the same rows on all axes, of which `rows` lists those of axis 0
  };
  /// A node that friction holds across its slip more stiffly than single precision bears.
  struct StiffSlip {
    std::int64_t node;
    double across[3];
    double compliance;  // [m/N]
  };
  /// Nodes in contact; those that all but stick are kept from moving across, and put aside.
  std::vector<HeldNode> without_stiff_slips();
  /// What these move across, each by its own compliance.
  void add_stiff_slips(const Vector& r, Vector& z) const;
  void make_rows();
  void prepare_columns();
  void factorize_group(Group& group);
  double inverse_entry(std::size_t i, std::size_t j, int axis) const;
  void subtract_columns(Vector& z) const;
  /// z = A^-1 r made to leave alone what contact takes away.
  /// @param[in] r  may be null: z is no solution, and columns alone correct it
  void hold(const Vector* r, Vector& z);

  StepProblem& problem_;
  const ConstantSystem& system_;
  const ContactSpace& space_;
  bool cache_columns_;
  Kind kind_ = Kind::kBase;
  ThreadPool& pool_;
  std::vector<std::int64_t> active_;         // nodes in contact
  std::vector<std::size_t> active_contact_;  // and their contacts
  std::vector<Group> groups_;
  std::vector<StiffSlip> stiff_slips_;
  std::unique_ptr<InverseColumns> own_columns_;
  InverseColumns* columns_ = nullptr;
  RigidRotations rotations_;
  Vector multiplier_, second_;  // (active, 3); scratch
};

}  // namespace diffsim
