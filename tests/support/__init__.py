"""What several tests use: harnesses, made scenes, references, programs to compare with."""
