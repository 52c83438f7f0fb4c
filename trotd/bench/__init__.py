"""``trotd bench``: what the numbers in docs/performance.md come from. Ratios are measured side by side in one run."""
