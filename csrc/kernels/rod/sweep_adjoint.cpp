#include "kernels/rod/sweep.h"

namespace diffsim::rod {

namespace {

/// From the outputs of a sweep back to its inputs, in the reverse order of Sweep::run.
template <class T>
class Reverse {
 public:
  Reverse(const Sweep<T>& sweep, T* grad_numbers, T* grad_u)
      : s_(sweep),
        n_(sweep.n),
        grad_(grad_numbers),
        u_(grad_u),
        edges_(9 * (n_ + 1)),
        middles_(9 * n_),
        force_(3 * n_),
        along_(3 * n_),
        nodes_(3 * (n_ + 1)),
        centers_(3 * n_),
        stretch_(3 * n_),
        places_(3 * sweep.body.num_points) {}

  void run(const T* residual, const T* places) {
    std::copy_n(places, places_.size(), places_.begin());
    balance(residual);
    for (std::int64_t p = 0; p < s_.body.num_points; ++p) place(p);
    follow_nodes();
    std::vector<T> turns(n_);
    for (std::int64_t i = 0; i < n_; ++i) section(i, residual + 3 * i, &turns[i]);
    pull(turns);
    sum_forces();
    for (std::int64_t i = n_ - 1; i >= 0; --i) turn_frame(i);
    for (int k = 0; k < 9; ++k) field(kBase)[k] += edges_[k];
  }

 private:
  T* field(Field f) { return grad_ + s_.begin[f]; }

  void balance(const T* residual) {
    const T* weight = s_.field(kWeight);
    std::vector<T> of_loads(3 * s_.body.num_loads);
    T beyond[3] = {};  // sum of dL/d(outer) before the element
    for (std::int64_t i = 0; i < n_; ++i) {
      T g[3] = {};  // dL/d(outer)
      add_product(&s_.middles[9 * i], residual + 3 * i, g);
      for (T& x : g) x = -x;
      add_outer(-1.0, &s_.outer[3 * i], residual + 3 * i, &middles_[9 * i]);
      for (std::int64_t p = 0; p < s_.body.num_loads; ++p)
        if (s_.is_beyond(p, i)) add(1.0, g, &of_loads[3 * p]);
      T *of_center = &centers_[3 * i], *of_weight = field(kWeight) + 3 * i;
      const T* center = &s_.centers[3 * i];
      // c x w of those before it, then force x c, then (c + h d / 4) x w / 2
      add_cross(weight + 3 * i, beyond, of_center), add_cross(beyond, center, of_weight);
      add_cross(g, &s_.force[3 * i], of_center), add_cross(center, g, &force_[3 * i]);
      T at[3], of_at[3] = {}, of_own[3] = {};
      const double quarter = 0.25 * s_.length(i);
      for (int k = 0; k < 3; ++k) at[k] = center[k] + quarter * s_.along[3 * i + k];
      add_cross(weight + 3 * i, g, of_at), add_cross(g, at, of_own);
      add(0.5, of_own, of_weight), add(0.5, of_at, of_center);
      add(0.5 * quarter, of_at, &along_[3 * i]);
      add(1.0, g, beyond);
    }
    for (std::int64_t p = 0; p < s_.body.num_loads; ++p) {
      add_cross(s_.field(kLoads) + 3 * p, &of_loads[3 * p], &places_[3 * p]);
      add_cross(&of_loads[3 * p], &s_.places[3 * p], field(kLoads) + 3 * p);
    }
  }

  void place(std::int64_t p) {
    const std::int64_t i = s_.body.around[p];
    const auto f = s_.point_frames(p);
    const T *g = &places_[3 * p], *offset = s_.field(kPoints) + 3 * p;
    T there[9] = {}, turned[9] = {}, halfway[9] = {}, w[3];
    add(1.0, g, &nodes_[3 * i]);
    T of_stretch[3] = {};
    add_transposed(f.turned, g, of_stretch);
    add(f.past, of_stretch, &stretch_[3 * i]);
    add_outer(f.past, g, s_.stretch(i), turned);
    add_transposed(f.there, g, field(kPoints) + 3 * p);
    add_outer(1.0, g, offset, there);
    multiply_vjp(f.turned, f.halfway, there, turned, halfway);
    multiply_vjp(&s_.edges[9 * i], f.halfway, turned, &edges_[9 * i], halfway);
    for (int k = 0; k < 3; ++k) w[k] = 0.5 * f.past * s_.u[3 * i + k];
    turn_vjp(w, halfway, 0.5 * f.past, u_ + 3 * i);
  }

  void follow_nodes() {
    for (std::int64_t i = n_ - 1; i >= 0; --i) {
      T *behind = &nodes_[3 * (i + 1)], *before = &nodes_[3 * i], *center = &centers_[3 * i];
      add(s_.length(i), behind, &along_[3 * i]), add(0.5 * s_.length(i), center, &along_[3 * i]);
      add(1.0, behind, before), add(1.0, center, before);
    }
    add(1.0, nodes_.data(), field(kPlace));
  }

  /// @param[out] of_wrapped dL/d(wrapped) of the element
  void section(std::int64_t i, const T* residual, T* of_wrapped) {
    const std::int64_t num = s_.body.num_tendons;
    const T* middle = &s_.middles[9 * i];
    add_outer(1.0, &along_[3 * i], s_.stretch(i), &middles_[9 * i]);
    add_transposed(middle, &along_[3 * i], &stretch_[3 * i]);
    T local[3] = {};
    std::vector<T> tension(num);
    section_vjp(s_.section(i), &s_.rounds[3 * (kRounds + 1) * i], &stretch_[3 * i], residual,
                u_ + 3 * i, local, tension.data(), s_.section_numbers(grad_, i));
    add_outer(1.0, &s_.force[3 * i], local, &middles_[9 * i]);
    add_product(middle, local, &force_[3 * i]);
    const T friction = *s_.field(kFriction), wobble = *s_.field(kWobble);
    const T left = exp_of(-(friction * s_.wrapped[i] + wobble * s_.middle(i)));
    T of_loss = T{};
    for (std::int64_t t = 0; t < num; ++t) {
      const T pull = s_.field(kPull)[t], share = s_.field(kShare)[t * n_ + i];
      field(kPull)[t] += tension[t] * share * left;
      field(kShare)[t * n_ + i] += tension[t] * pull * left;
      of_loss -= tension[t] * pull * share * left;
    }
    *field(kFriction) += of_loss * s_.wrapped[i];
    *field(kWobble) += of_loss * s_.middle(i);
    *of_wrapped = of_loss * friction;
  }

  void pull(const std::vector<T>& of_wrapped) {
    T beyond{};
    for (std::int64_t i = n_ - 1; i >= 0; --i) {
      const T g = beyond + 0.5 * of_wrapped[i], h = T{} + s_.length(i);
      for (int k = 1; k < 3; ++k) u_[3 * i + k] += g * h * h * s_.u[3 * i + k] / s_.turns[i];
      beyond += of_wrapped[i];
    }
  }

  void sum_forces() {
    T before[3] = {};
    for (std::int64_t i = 0; i < n_; ++i) {
      add(1.0, before, field(kWeight) + 3 * i), add(0.5, &force_[3 * i], field(kWeight) + 3 * i);
      add(1.0, &force_[3 * i], before);
      for (std::int64_t p = 0; p < s_.body.num_loads; ++p)
        if (s_.is_beyond(p, i)) add(1.0, &force_[3 * i], field(kLoads) + 3 * p);
    }
  }

  void turn_frame(std::int64_t i) {
    T half[9] = {}, w[3];
    multiply_vjp(&s_.middles[9 * i], &s_.halves[9 * i], &edges_[9 * (i + 1)], &middles_[9 * i],
                 half);
    multiply_vjp(&s_.edges[9 * i], &s_.halves[9 * i], &middles_[9 * i], &edges_[9 * i], half);
    for (int k = 0; k < 3; ++k) w[k] = 0.5 * s_.length(i) * s_.u[3 * i + k];
    turn_vjp(w, half, 0.5 * s_.length(i), u_ + 3 * i);
  }

  const Sweep<T>& s_;
  std::int64_t n_;
  T *grad_, *u_;
  // dL/d of what a sweep has under these names
  std::vector<T> edges_, middles_, force_, along_, nodes_, centers_, stretch_, places_;
};

}  // namespace

template <class T>
void reverse(const Sweep<T>& s, const T* grad_residual, const T* grad_places, T* grad_numbers,
             T* grad_u) {
  Reverse<T>(s, grad_numbers, grad_u).run(grad_residual, grad_places);
}
template void reverse(const Sweep<double>&, const double*, const double*, double*, double*);
template void reverse(const Sweep<Native>&, const Native*, const Native*, Native*, Native*);

}  // namespace diffsim::rod
