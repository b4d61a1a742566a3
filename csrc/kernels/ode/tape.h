// Formulas as tapes: instructions in static single assignment on registers of lanes.
//
// A tape is made in Python from parsed formulas (diffsim/ode/tape.py). Registers hold `Lanes`
// numbers side by side, one for each member of a batch; instruction i writes register
// num_given + i, so a register is written once and the reverse sweep needs no copies.
#pragma once

#include <cmath>
#include <cstdint>

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
  kNumOps,
};

struct TapeInstruction {
  std::int64_t op, a, b, c;
};

/// @param code     (num_code) instructions
/// @param num_given registers that hold what the formulas are made of, before those of the code
struct Tape {
  const TapeInstruction* code;
  std::int64_t num_code;
  std::int64_t num_given;
  std::int64_t num_registers() const { return num_given + num_code; }
};

/// Fills the registers behind the given ones.
template <int Lanes>
void run_tape(const Tape& tape, double* registers) {
  const auto at = [registers](std::int64_t r) { return registers + r * Lanes; };
  for (std::int64_t i = 0; i < tape.num_code; ++i) {
    const TapeInstruction& t = tape.code[i];
    const double* a = at(t.a);
    const double* b = at(t.b);
    const double* c = at(t.c);
    double* y = at(tape.num_given + i);
    const auto each = [y](auto f) {
      for (int l = 0; l < Lanes; ++l) y[l] = f(l);
    };
    switch (static_cast<TapeOp>(t.op)) {
      case TapeOp::kAdd:
        each([=](int l) { return a[l] + b[l]; });
        break;
      case TapeOp::kSub:
        each([=](int l) { return a[l] - b[l]; });
        break;
      case TapeOp::kMul:
        each([=](int l) { return a[l] * b[l]; });
        break;
      case TapeOp::kDiv:
        each([=](int l) { return a[l] / b[l]; });
        break;
      case TapeOp::kPow:
        each([=](int l) { return std::pow(a[l], b[l]); });
        break;
      case TapeOp::kNeg:
        each([=](int l) { return -a[l]; });
        break;
      case TapeOp::kLess:
        each([=](int l) { return a[l] < b[l] ? 1.0 : 0.0; });
        break;
      case TapeOp::kLessEqual:
        each([=](int l) { return a[l] <= b[l] ? 1.0 : 0.0; });
        break;
      case TapeOp::kMin:
        each([=](int l) { return b[l] < a[l] ? b[l] : a[l]; });
        break;
      case TapeOp::kMax:
        each([=](int l) { return b[l] > a[l] ? b[l] : a[l]; });
        break;
      case TapeOp::kWhere:
        each([=](int l) { return a[l] != 0.0 ? b[l] : c[l]; });
        break;
      case TapeOp::kAbs:
        each([=](int l) { return std::fabs(a[l]); });
        break;
      case TapeOp::kSign:
        each([=](int l) { return static_cast<double>((a[l] > 0.0) - (a[l] < 0.0)); });
        break;
      case TapeOp::kSqrt:
        each([=](int l) { return std::sqrt(a[l]); });
        break;
      case TapeOp::kExp:
        each([=](int l) { return std::exp(a[l]); });
        break;
      case TapeOp::kLog:
        each([=](int l) { return std::log(a[l]); });
        break;
      case TapeOp::kSin:
        each([=](int l) { return std::sin(a[l]); });
        break;
      case TapeOp::kCos:
        each([=](int l) { return std::cos(a[l]); });
        break;
      case TapeOp::kTan:
        each([=](int l) { return std::tan(a[l]); });
        break;
      case TapeOp::kAsin:
        each([=](int l) { return std::asin(a[l]); });
        break;
      case TapeOp::kAcos:
        each([=](int l) { return std::acos(a[l]); });
        break;
      case TapeOp::kAtan:
        each([=](int l) { return std::atan(a[l]); });
        break;
      case TapeOp::kSinh:
        each([=](int l) { return std::sinh(a[l]); });
        break;
      case TapeOp::kCosh:
        each([=](int l) { return std::cosh(a[l]); });
        break;
      case TapeOp::kTanh:
        each([=](int l) { return std::tanh(a[l]); });
        break;
      case TapeOp::kAsinh:
        each([=](int l) { return std::asinh(a[l]); });
        break;
      case TapeOp::kAtan2:
        each([=](int l) { return std::atan2(a[l], b[l]); });
        break;
      case TapeOp::kHypot:
        each([=](int l) { return std::hypot(a[l], b[l]); });
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
  const double* a = registers + t.a * Lanes;
  const double* b = registers + t.b * Lanes;
  const double* y = registers + (tape.num_given + i) * Lanes;
  switch (static_cast<TapeOp>(t.op)) {
    case TapeOp::kAdd:
      visit(t.a, [](int) { return 1.0; });
      visit(t.b, [](int) { return 1.0; });
      break;
    case TapeOp::kSub:
      visit(t.a, [](int) { return 1.0; });
      visit(t.b, [](int) { return -1.0; });
      break;
    case TapeOp::kMul:
      visit(t.a, [=](int l) { return b[l]; });
      visit(t.b, [=](int l) { return a[l]; });
      break;
    case TapeOp::kDiv:
      visit(t.a, [=](int l) { return 1.0 / b[l]; });
      visit(t.b, [=](int l) { return -y[l] / b[l]; });
      break;
    case TapeOp::kPow:
      visit(t.a, [=](int l) { return b[l] == 0.0 ? 0.0 : b[l] * std::pow(a[l], b[l] - 1.0); });
      // of a power of zero or of a negative base, only whole exponents are meant
      visit(t.b, [=](int l) { return a[l] > 0.0 ? y[l] * std::log(a[l]) : 0.0; });
      break;
    case TapeOp::kNeg:
      visit(t.a, [](int) { return -1.0; });
      break;
    case TapeOp::kMin:
      visit(t.a, [=](int l) { return b[l] < a[l] ? 0.0 : 1.0; });
      visit(t.b, [=](int l) { return b[l] < a[l] ? 1.0 : 0.0; });
      break;
    case TapeOp::kMax:
      visit(t.a, [=](int l) { return b[l] > a[l] ? 0.0 : 1.0; });
      visit(t.b, [=](int l) { return b[l] > a[l] ? 1.0 : 0.0; });
      break;
    case TapeOp::kWhere:
      visit(t.b, [=](int l) { return a[l] != 0.0 ? 1.0 : 0.0; });
      visit(t.c, [=](int l) { return a[l] != 0.0 ? 0.0 : 1.0; });
      break;
    case TapeOp::kAbs:
      visit(t.a, [=](int l) { return static_cast<double>((a[l] > 0.0) - (a[l] < 0.0)); });
      break;
    case TapeOp::kSqrt:
      visit(t.a, [=](int l) { return 0.5 / y[l]; });
      break;
    case TapeOp::kExp:
      visit(t.a, [=](int l) { return y[l]; });
      break;
    case TapeOp::kLog:
      visit(t.a, [=](int l) { return 1.0 / a[l]; });
      break;
    case TapeOp::kSin:
      visit(t.a, [=](int l) { return std::cos(a[l]); });
      break;
    case TapeOp::kCos:
      visit(t.a, [=](int l) { return -std::sin(a[l]); });
      break;
    case TapeOp::kTan:
      visit(t.a, [=](int l) { return 1.0 + y[l] * y[l]; });
      break;
    case TapeOp::kAsin:
      visit(t.a, [=](int l) { return 1.0 / std::sqrt(1.0 - a[l] * a[l]); });
      break;
    case TapeOp::kAcos:
      visit(t.a, [=](int l) { return -1.0 / std::sqrt(1.0 - a[l] * a[l]); });
      break;
    case TapeOp::kAtan:
      visit(t.a, [=](int l) { return 1.0 / (1.0 + a[l] * a[l]); });
      break;
    case TapeOp::kSinh:
      visit(t.a, [=](int l) { return std::cosh(a[l]); });
      break;
    case TapeOp::kCosh:
      visit(t.a, [=](int l) { return std::sinh(a[l]); });
      break;
    case TapeOp::kTanh:
      visit(t.a, [=](int l) { return 1.0 - y[l] * y[l]; });
      break;
    case TapeOp::kAsinh:
      visit(t.a, [=](int l) { return 1.0 / std::sqrt(1.0 + a[l] * a[l]); });
      break;
    case TapeOp::kAtan2:
      visit(t.a, [=](int l) { return b[l] / (a[l] * a[l] + b[l] * b[l]); });
      visit(t.b, [=](int l) { return -a[l] / (a[l] * a[l] + b[l] * b[l]); });
      break;
    case TapeOp::kHypot:
      visit(t.a, [=](int l) { return a[l] / y[l]; });
      visit(t.b, [=](int l) { return b[l] / y[l]; });
      break;
    case TapeOp::kLess:
    case TapeOp::kLessEqual:
    case TapeOp::kSign:
    case TapeOp::kNumOps:
      break;  // piecewise constant
  }
}

/// Reverse sweep: adds dL/d(given registers) to their adjoints.
/// @param registers as run_tape left them
/// @param adjoints  (num_registers, Lanes) dL/d(register); those of the code are used up (left 0)
template <int Lanes>
void reverse_tape(const Tape& tape, const double* registers, double* adjoints) {
  for (std::int64_t i = tape.num_code - 1; i >= 0; --i) {
    double* gy = adjoints + (tape.num_given + i) * Lanes;
    each_partial<Lanes>(tape, i, registers, [=](std::int64_t operand, auto slope) {
      double* g = adjoints + operand * Lanes;
      // 0 times infinity is no gradient: what does not reach the result passes nothing on, and
      // nothing passes what is flat, as a root of max(u, 0) below 0
      for (int l = 0; l < Lanes; ++l)
        if (gy[l] != 0.0)
          if (const double s = slope(l); s != 0.0) g[l] += gy[l] * s;
    });
    for (int l = 0; l < Lanes; ++l) gy[l] = 0.0;
  }
}

/// Forward sweep: fills the tangents of the registers behind the given ones.
/// @param registers as run_tape left them
/// @param tangents  (num_registers, Lanes) d(register)
template <int Lanes>
void tangent_tape(const Tape& tape, const double* registers, double* tangents) {
  for (std::int64_t i = 0; i < tape.num_code; ++i) {
    double* dy = tangents + (tape.num_given + i) * Lanes;
    for (int l = 0; l < Lanes; ++l) dy[l] = 0.0;
    each_partial<Lanes>(tape, i, registers, [=](std::int64_t operand, auto slope) {
      const double* d = tangents + operand * Lanes;
      for (int l = 0; l < Lanes; ++l)
        if (d[l] != 0.0) dy[l] += slope(l) * d[l];
    });
  }
}

}  // namespace diffsim
