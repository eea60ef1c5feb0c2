"""A SunSpec device on Modbus/TCP beside a run: what it measures, and an operator's commands."""
