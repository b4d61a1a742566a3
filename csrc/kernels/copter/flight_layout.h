// Where the numbers of one vehicle and of its effects stand in a flat row.
#pragma once

#include <array>

namespace diffsim {

constexpr int kMaxRotors = 16;

/// Entries of the rigid body's state: position, quaternion, velocity, body rates, charge.
constexpr int kPosition = 0, kQuaternion = 3, kVelocity = 7, kRates = 10, kCharge = 13;
constexpr int kBody = 14;      ///< a record is these and the thrust state of every rotor
constexpr int kFeedback = 12;  ///< the minimal state that a feedback gain multiplies

/// Offsets into a row of parameters; kFlightFields says what they hold.
struct FlightLayout {
  int num_rotors, size;
  int inverse_mass, inertia, inertia_inverse, arms, axes, reactions, max_thrusts;
  int lag_decay, curve_exponent, curve_reference;
  int rotor_drag, drag_linear, drag_quadratic;
  int ground_coefficient, terrain_height, radii, interference;
  int resistance, inverse_capacity, nominal_voltage, sag_exponent, open_circuit;
  int current_coefficient, current_exponent, idle_current;

  explicit FlightLayout(int n);
};

/// Size of a field: constant + per_rotor n + per_pair n^2.
struct FlightField {
  const char* name;
  int FlightLayout::* offset;
  int constant, per_rotor, per_pair;
  int size(int n) const { return constant + per_rotor * n + per_pair * n * n; }
};

inline constexpr std::array<FlightField, 25> kFlightFields{{
    {"inverse_mass", &FlightLayout::inverse_mass, 1, 0, 0},        // [1/kg]
    {"inertia", &FlightLayout::inertia, 9, 0, 0},                  // [kg m^2], by rows
    {"inertia_inverse", &FlightLayout::inertia_inverse, 9, 0, 0},  // [1/(kg m^2)], by rows
    {"arms", &FlightLayout::arms, 0, 3, 0},                        // hubs from the center [m]
    {"axes", &FlightLayout::axes, 0, 3, 0},                        // d_i
    {"reactions", &FlightLayout::reactions, 0, 3, 0},              // b_i lambda_i d_i [m]
    {"max_thrusts", &FlightLayout::max_thrusts, 0, 1, 0},          // [N]
    {"lag_decay", &FlightLayout::lag_decay, 0, 1, 0},              // exp(-dt / (2 tau))
    {"curve_exponent", &FlightLayout::curve_exponent, 0, 1, 0},
    {"curve_reference", &FlightLayout::curve_reference, 0, 1, 0},  // [N]
    {"rotor_drag", &FlightLayout::rotor_drag, 1, 0, 0},            // [s/m]
    {"drag_linear", &FlightLayout::drag_linear, 3, 0, 0},          // [N s/m]
    {"drag_quadratic", &FlightLayout::drag_quadratic, 3, 0, 0},    // [N s^2/m^2]
    {"ground_coefficient", &FlightLayout::ground_coefficient, 1, 0, 0},
    {"terrain_height", &FlightLayout::terrain_height, 1, 0, 0},      // above the origin [m]
    {"radii", &FlightLayout::radii, 0, 1, 0},                        // [m]
    {"interference", &FlightLayout::interference, 0, 0, 1},          // N lost by i per N of j
    {"resistance", &FlightLayout::resistance, 1, 0, 0},              // [ohm]
    {"inverse_capacity", &FlightLayout::inverse_capacity, 1, 0, 0},  // [1/(A s)]
    {"nominal_voltage", &FlightLayout::nominal_voltage, 1, 0, 0},    // [V]
    {"sag_exponent", &FlightLayout::sag_exponent, 1, 0, 0},
    {"open_circuit", &FlightLayout::open_circuit, 4, 0, 0},  // V = sum_j c_j charge^j [V]
    {"current_coefficient", &FlightLayout::current_coefficient, 0, 1, 0},  // A = a u^alpha
    {"current_exponent", &FlightLayout::current_exponent, 0, 1, 0},
    {"idle_current", &FlightLayout::idle_current, 1, 0, 0},  // [A]
}};

inline FlightLayout::FlightLayout(int n) : num_rotors(n), size(0) {
  for (const FlightField& field : kFlightFields) {
    this->*field.offset = size;
    size += field.size(n);
  }
}

}  // namespace diffsim
