"""A SunSpec device on Modbus/TCP beside a run: measurements and an operator's commands."""
