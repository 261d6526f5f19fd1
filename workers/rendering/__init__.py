"""New views of a scene, plain or on a stage: what commands and jobs do alike. Shows nothing itself."""
