// Formulas as tapes: instructions in static single assignment on registers of lanes.
//
// A tape is made in Python from parsed formulas (diffsim/ode/tape.py). Registers hold `Lanes`
// numbers side by side, one for each member of a batch, in whole SIMD registers; instruction i
// writes register num_given + i, so a register is written once and the reverse sweep needs no
// copies. Instructions stand in parts by what they need: a part is run when that has changed.
#pragma once

#include <cmath>
#include <cstdint>
#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#include "kernels/ode/elementary.h"

namespace diffsim {

/// What an instruction does with registers a, b and c; the numbers are those of tape.py.
enum class TapeOp : std::int64_t {
  kAdd = 0,
  kSub,
  kMul,
  kDiv,
  kPow,
  kNeg,
  kLess,
  kLessEqual,
  kMin,
  kMax,
  kWhere,  // b where a is not 0, else c
  kAbs,
  kSign,
  kSqrt,
  kExp,
  kLog,
  kSin,
  kCos,
  kTan,
  kAsin,
  kAcos,
  kAtan,
  kSinh,
  kCosh,
  kTanh,
  kAsinh,
  kAtan2,
  kHypot,
  kMulAdd,  // a b + c
  kMulSub,  // a b - c
  kSubMul,  // c - a b
  kNumOps,
};

struct TapeInstruction {
  std::int64_t op, a, b, c;
};

/// What the instructions of a part need: parameters alone; for the rates, time and inputs besides,
/// or states; what only readings need.
enum TapePart { kFixed, kDriven, kMoving, kReadings };

/// @param code     (num_code) instructions
/// @param ends     (4) where the parts of the code end
/// @param num_given registers that hold what the formulas are made of, before those of the code
struct Tape {
  const TapeInstruction* code;
  const std::int64_t* ends;
  std::int64_t num_code;
  std::int64_t num_given;
  std::int64_t num_registers() const { return num_given + num_code; }
  std::int64_t begin(TapePart part) const { return part == kFixed ? 0 : ends[part - 1]; }
  std::int64_t end(TapePart part) const { return ends[part]; }
};

namespace detail {

DIFFSIM_INLINE Native one_where(const NativeMask& mask) {
  return keep<Native>(mask, broadcast<Native>(1.0));
}
DIFFSIM_INLINE Native sign(const Native& a) {
  return one_where(less<Native>(Native{}, a)) - one_where(less<Native>(a, Native{}));
}
DIFFSIM_INLINE NativeMask not_zero(const Native& a) {
#if defined(__SSE2__) && !defined(__AVX__)
  // g++ 12 fails ("gimple_expand_vec_cond_expr") where it joins such a comparison with another
  return (NativeMask)_mm_cmpneq_pd(a, Native{});
#else
  return a != Native{};
#endif
}
inline Native pow(const Native& a, const Native& b) {
  return each_lane(a, b, [](double base, double power) { return std::pow(base, power); });
}
/// d/da of a^b.
inline Native pow_slope(const Native& a, const Native& b) {
  return each_lane(a, b, [](double base, double power) {
    return power == 0.0 ? 0.0 : power * std::pow(base, power - 1.0);
  });
}

}  // namespace detail

/// Fills the registers of a part of the code.
///
/// Equal operations stand side by side (tape.py), so that one is looked up for many rows.
template <int Lanes>
void run_tape(const Tape& tape, TapePart part, double* registers) {
  const std::int64_t end = tape.end(part);
  for (std::int64_t begin = tape.begin(part), next; begin < end; begin = next) {
    const std::int64_t op = tape.code[begin].op;
    for (next = begin + 1; next < end && tape.code[next].op == op;) ++next;
    const auto each = [=, code = tape.code, to = registers + tape.num_given * Lanes](auto f) {
      for (std::int64_t i = begin; i < next; ++i) {
        const TapeInstruction& t = code[i];
        const double* a = registers + t.a * Lanes;
        const double* b = registers + t.b * Lanes;
        const double* c = registers + t.c * Lanes;
        for (int l = 0; l < Lanes; l += kNativeLanes)
          store<Native>(to + i * Lanes + l,
                        f(load<Native>(a + l), load<Native>(b + l), load<Native>(c + l)));
      }
    };
    const auto unary = [&](auto f) {
      each([=](const Native& a, const Native&, const Native&) { return Native(f(a)); });
    };
    const auto binary = [&](auto f) {
      each([=](const Native& a, const Native& b, const Native&) { return Native(f(a, b)); });
    };
    const auto ternary = [&](auto f) {
      each([=](const Native& a, const Native& b, const Native& c) { return Native(f(a, b, c)); });
    };
    const auto alone = [&](auto f) { unary([=](const Native& a) { return each_lane(a, f); }); };
    using V = const Native&;
    switch (static_cast<TapeOp>(op)) {
      case TapeOp::kAdd:
        binary([](V a, V b) { return a + b; });
        break;
      case TapeOp::kSub:
        binary([](V a, V b) { return a - b; });
        break;
      case TapeOp::kMul:
        binary([](V a, V b) { return a * b; });
        break;
      case TapeOp::kMulAdd:
        ternary([](V a, V b, V c) { return a * b + c; });
        break;
      case TapeOp::kMulSub:
        ternary([](V a, V b, V c) { return a * b - c; });
        break;
      case TapeOp::kSubMul:
        ternary([](V a, V b, V c) { return c - a * b; });
        break;
      case TapeOp::kDiv:
        binary([](V a, V b) { return a / b; });
        break;
      case TapeOp::kPow:
        binary([](V a, V b) { return detail::pow(a, b); });
        break;
      case TapeOp::kNeg:
        unary([](V a) { return -a; });
        break;
      case TapeOp::kLess:
        binary([](V a, V b) { return detail::one_where(less<Native>(a, b)); });
        break;
      case TapeOp::kLessEqual:
        binary([](V a, V b) { return detail::one_where(a <= b); });
        break;
      case TapeOp::kMin:
        binary([](V a, V b) { return select<Native>(less<Native>(b, a), b, a); });
        break;
      case TapeOp::kMax:
        binary([](V a, V b) { return select<Native>(less<Native>(a, b), b, a); });
        break;
      case TapeOp::kWhere:
        ternary([](V a, V b, V c) { return select<Native>(detail::not_zero(a), b, c); });
        break;
      case TapeOp::kAbs:
        unary([](V a) { return abs(a); });
        break;
      case TapeOp::kSign:
        unary([](V a) { return detail::sign(a); });
        break;
      case TapeOp::kSqrt:
        unary([](V a) { return sqrt(a); });
        break;
      case TapeOp::kExp:
        unary([](V a) { return exp(a); });
        break;
      case TapeOp::kLog:
        alone([](double x) { return std::log(x); });
        break;
      case TapeOp::kSin:
        unary([](V a) { return sin(a); });
        break;
      case TapeOp::kCos:
        unary([](V a) { return cos(a); });
        break;
      case TapeOp::kTan:
        alone([](double x) { return std::tan(x); });
        break;
      case TapeOp::kAsin:
        alone([](double x) { return std::asin(x); });
        break;
      case TapeOp::kAcos:
        alone([](double x) { return std::acos(x); });
        break;
      case TapeOp::kAtan:
        alone([](double x) { return std::atan(x); });
        break;
      case TapeOp::kSinh:
        alone([](double x) { return std::sinh(x); });
        break;
      case TapeOp::kCosh:
        alone([](double x) { return std::cosh(x); });
        break;
      case TapeOp::kTanh:
        unary([](V a) { return tanh(a); });
        break;
      case TapeOp::kAsinh:
        alone([](double x) { return std::asinh(x); });
        break;
      case TapeOp::kAtan2:
        binary([](V a, V b) {
          return each_lane(a, b, [](double y, double x) { return std::atan2(y, x); });
        });
        break;
      case TapeOp::kHypot:
        binary([](V a, V b) {
          return each_lane(a, b, [](double x, double y) { return std::hypot(x, y); });
        });
        break;
      case TapeOp::kNumOps:
        break;
    }
  }
}

/// Calls visit(operand's register, slope by lane) for every operand that result i depends on.
///
/// At kinks the derivative is that of one side: abs and sign 0 at 0, min and max of the first.
/// @param registers as run_tape left them
template <int Lanes, typename Visit>
void each_partial(const Tape& tape, std::int64_t i, const double* registers, const Visit& visit) {
  const TapeInstruction& t = tape.code[i];
  const auto of = [registers](std::int64_t r) {
    return [from = registers + r * Lanes](int l) { return load<Native>(from + l); };
  };
  const auto a = of(t.a), b = of(t.b), y = of(tape.num_given + i);
  const auto one = [](int) { return broadcast<Native>(1.0); };
  const auto minus_one = [](int) { return broadcast<Native>(-1.0); };
  const auto product = [&](auto&& of_product) {
    visit(t.a, [=](int l) { return of_product(l) * b(l); });
    visit(t.b, [=](int l) { return of_product(l) * a(l); });
  };
  switch (static_cast<TapeOp>(t.op)) {
    case TapeOp::kAdd:
      visit(t.a, one);
      visit(t.b, one);
      break;
    case TapeOp::kSub:
      visit(t.a, one);
      visit(t.b, minus_one);
      break;
    case TapeOp::kMul:
      product(one);
      break;
    case TapeOp::kMulAdd:
      product(one);
      visit(t.c, one);
      break;
    case TapeOp::kMulSub:
      product(one);
      visit(t.c, minus_one);
      break;
    case TapeOp::kSubMul:
      product(minus_one);
      visit(t.c, one);
      break;
    case TapeOp::kDiv:
      visit(t.a, [=](int l) { return 1.0 / b(l); });
      visit(t.b, [=](int l) { return -y(l) / b(l); });
      break;
    case TapeOp::kPow:
      visit(t.a, [=](int l) { return detail::pow_slope(a(l), b(l)); });
      // of a power of zero or of a negative base, only whole exponents are meant
      visit(t.b, [=](int l) {
        return each_lane(a(l), y(l),
                         [](double x, double p) { return x > 0.0 ? p * std::log(x) : 0.0; });
      });
      break;
    case TapeOp::kNeg:
      visit(t.a, minus_one);
      break;
    case TapeOp::kMin:
      visit(t.a, [=](int l) { return 1.0 - detail::one_where(less<Native>(b(l), a(l))); });
      visit(t.b, [=](int l) { return detail::one_where(less<Native>(b(l), a(l))); });
      break;
    case TapeOp::kMax:
      visit(t.a, [=](int l) { return 1.0 - detail::one_where(less<Native>(a(l), b(l))); });
      visit(t.b, [=](int l) { return detail::one_where(less<Native>(a(l), b(l))); });
      break;
    case TapeOp::kWhere:
      visit(t.b, [=](int l) { return detail::one_where(detail::not_zero(a(l))); });
      visit(t.c, [=](int l) { return 1.0 - detail::one_where(detail::not_zero(a(l))); });
      break;
    case TapeOp::kAbs:
      visit(t.a, [=](int l) { return detail::sign(a(l)); });
      break;
    case TapeOp::kSqrt:
      visit(t.a, [=](int l) { return 0.5 / y(l); });
      break;
    case TapeOp::kExp:
      visit(t.a, y);
      break;
    case TapeOp::kLog:
      visit(t.a, [=](int l) { return 1.0 / a(l); });
      break;
    case TapeOp::kSin:
      visit(t.a, [=](int l) { return cos(a(l)); });
      break;
    case TapeOp::kCos:
      visit(t.a, [=](int l) { return -sin(a(l)); });
      break;
    case TapeOp::kTan:
      visit(t.a, [=](int l) { return 1.0 + y(l) * y(l); });
      break;
    case TapeOp::kAsin:
      visit(t.a, [=](int l) { return 1.0 / sqrt<Native>(1.0 - a(l) * a(l)); });
      break;
    case TapeOp::kAcos:
      visit(t.a, [=](int l) { return -1.0 / sqrt<Native>(1.0 - a(l) * a(l)); });
      break;
    case TapeOp::kAtan:
      visit(t.a, [=](int l) { return 1.0 / (1.0 + a(l) * a(l)); });
      break;
    case TapeOp::kSinh:
      visit(t.a, [=](int l) { return each_lane(a(l), [](double x) { return std::cosh(x); }); });
      break;
    case TapeOp::kCosh:
      visit(t.a, [=](int l) { return each_lane(a(l), [](double x) { return std::sinh(x); }); });
      break;
    case TapeOp::kTanh:
      visit(t.a, [=](int l) { return 1.0 - y(l) * y(l); });
      break;
    case TapeOp::kAsinh:
      visit(t.a, [=](int l) { return 1.0 / sqrt<Native>(1.0 + a(l) * a(l)); });
      break;
    case TapeOp::kAtan2:
      visit(t.a, [=](int l) { return b(l) / (a(l) * a(l) + b(l) * b(l)); });
      visit(t.b, [=](int l) { return -a(l) / (a(l) * a(l) + b(l) * b(l)); });
      break;
    case TapeOp::kHypot:
      visit(t.a, [=](int l) { return a(l) / y(l); });
      visit(t.b, [=](int l) { return b(l) / y(l); });
      break;
    case TapeOp::kLess:
    case TapeOp::kLessEqual:
    case TapeOp::kSign:
    case TapeOp::kNumOps:
      break;  // piecewise constant
  }
}

/// Reverse sweep over a part: adds dL/d(registers before it) to their adjoints.
/// @param registers as run_tape left them
/// @param adjoints  (num_registers, Lanes) dL/d(register); those of the part are used up (left 0)
template <int Lanes>
void reverse_tape(const Tape& tape, TapePart part, const double* registers, double* adjoints) {
  for (std::int64_t i = tape.end(part) - 1; i >= tape.begin(part); --i) {
    double* gy = adjoints + (tape.num_given + i) * Lanes;
    each_partial<Lanes>(tape, i, registers, [=](std::int64_t operand, auto slope) {
      double* to = adjoints + operand * Lanes;
      // 0 times infinity is no gradient: what does not reach the result passes nothing on, and
      // nothing passes what is flat, as a root of max(u, 0) below 0
      for (int l = 0; l < Lanes; l += kNativeLanes) {
        const Native g = load<Native>(gy + l);
        if (!any(detail::not_zero(g))) continue;
        const Native s = slope(l);
        const NativeMask reaches = detail::not_zero(g) & detail::not_zero(s);
        store<Native>(to + l, load<Native>(to + l) + keep<Native>(reaches, g * s));
      }
    });
    for (int l = 0; l < Lanes; ++l) gy[l] = 0.0;
  }
}

/// Forward sweep: fills the tangents of the registers of a part.
/// @param registers as run_tape left them
/// @param tangents  (num_registers, Lanes) d(register)
template <int Lanes>
void tangent_tape(const Tape& tape, TapePart part, const double* registers, double* tangents) {
  for (std::int64_t i = tape.begin(part); i < tape.end(part); ++i) {
    double* dy = tangents + (tape.num_given + i) * Lanes;
    for (int l = 0; l < Lanes; ++l) dy[l] = 0.0;
    each_partial<Lanes>(tape, i, registers, [=](std::int64_t operand, auto slope) {
      for (int l = 0; l < Lanes; l += kNativeLanes) {
        const Native d = load<Native>(tangents + operand * Lanes + l);
        const Native moved = keep<Native>(detail::not_zero(d), slope(l) * d);
        store<Native>(dy + l, load<Native>(dy + l) + moved);
      }
    });
  }
}

}  // namespace diffsim
