"""Triangle meshes and their materials, below the formats that read them."""
