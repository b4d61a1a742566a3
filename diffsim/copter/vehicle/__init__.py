"""What a multicopter is: its parts, rotors, battery, mass, and the effects on them."""
