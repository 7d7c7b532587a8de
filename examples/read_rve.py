"""Read an RVE file (docs/reference/rve.md) with h5py alone, and say what is in it.

python examples/read_rve.py out/homogenized/rve.h5
"""

import sys

import h5py


def read(path):
    """Arrays of the file by their names, and attributes of everything, those of the file at "/"."""
    arrays, attributes = {}, {}

    def keep(name, thing):
        attributes[name] = dict(thing.attrs)
        if isinstance(thing, h5py.Dataset):
            arrays[name] = thing[()]

    with h5py.File(path) as file:
        keep("/", file)
        file.visititems(keep)
    return arrays, attributes


if __name__ == "__main__":
    arrays, attributes = read(sys.argv[1])
    for name, values in arrays.items():
        print(name, values.shape, "[{unit}]: {meaning}".format(**attributes[name]))
