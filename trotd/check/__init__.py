"""``trotd check``: the pre-flight. Every row says what was found, and what to do about it where it is not right."""
