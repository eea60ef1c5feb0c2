"""Off-line design: linear model, margins and fixed-structure H-infinity synthesis."""
