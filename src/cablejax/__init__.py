"""Shape a cable with two robot grippers: simulate it, learn its dynamics, correct them online, plan with them.

Importing this package imports neither JAX nor MuJoCo; its modules do.
"""

import os

from cablejax.cores import available_cores

# jaxlib 0.10.2 can deadlock in batched MJX steps when XLA's CPU thread pool has only two threads, as it has on a
# two-core machine. XLA reads NPROC once, when JAX first computes, so it is set here unless somebody has decided.
if available_cores() < 4:
    os.environ.setdefault("NPROC", "4")

__version__ = "1.0.0"
