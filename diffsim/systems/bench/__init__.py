"""Rotors on a thrust stand: static readings of thrust, torque, speed and current."""
