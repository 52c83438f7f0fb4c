"""The operator's desk: clients of a running daemon."""
