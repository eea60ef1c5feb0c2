"""The H-infinity norm and the weighted channels of the performance problem."""
