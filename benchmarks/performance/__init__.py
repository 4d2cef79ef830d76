"""What `benchmarks/bench.py` measures: ours against what people use today and the machine's limit."""
