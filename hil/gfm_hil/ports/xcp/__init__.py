"""An XCP slave over UDP beside a run in progress: a calibration tool measures and calibrates it."""
