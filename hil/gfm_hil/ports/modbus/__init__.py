"""A run as a SunSpec device on Modbus/TCP: measurements, and commands of an operator."""
