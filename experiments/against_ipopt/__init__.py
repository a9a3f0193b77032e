"""Planning problems solved by the package's solvers and by IPOPT."""
