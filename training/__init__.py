"""The desktop: the teacher, the trainer and the proof."""
