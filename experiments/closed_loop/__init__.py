"""Comparing methods as Wang et al., RA-L 2022: trials, statistics, the paper's tables, protocols, failures shown."""
