"""The control core: the paper's pipeline as pure arithmetic, without input, output, clock or globals."""
