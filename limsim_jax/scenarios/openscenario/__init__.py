"""OpenSCENARIO XML 1.0 to 1.3: files to values, values to arrays, arrays to traffic."""
