"""What a photograph shows of a cellular specimen: material, holes, lattice, region."""
