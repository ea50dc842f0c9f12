"""What benchmarks share: options, timing, tables, inputs, peers."""
