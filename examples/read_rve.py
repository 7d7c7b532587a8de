"""Read an RVE file (docs/reference/rve.md) with h5py alone, and print its content.

python examples/read_rve.py out/homogenized/rve.h5
"""

import sys

import h5py


def read(path):
    """Arrays of a file by name; attributes of arrays and groups by name, "/" for the file's."""
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
