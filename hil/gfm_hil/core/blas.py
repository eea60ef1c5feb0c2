"""One thread for linear algebra, set before NumPy is first imported.

The matrices here are small: more threads only wait for each other and spin on processors that the
loop needs. A value that the user has set stays.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
