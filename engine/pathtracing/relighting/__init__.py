"""A scene with materials in another light: path traced or by the split sum."""
