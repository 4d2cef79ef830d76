"""How the code runs: kernels compiled and cached, threads, time taken, interrupts, late imports."""
