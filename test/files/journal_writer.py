"""Write a journal as the node does, until killed: `journal_writer.py FOLDER`.

Reading number n has n as its x. The file `FOLDER.accepted` has the number of accepted readings and the time (int64,
int64).
"""

from __future__ import annotations

import os
import struct
import sys
import time

from forward_grid_mapper.core.messages.reading_buffer import ReadingBuffer
from forward_grid_mapper.files.journal import Journal


def main(folder: str) -> None:
    journal = Journal(folder, print)
    buffer = ReadingBuffer()
    for readings in journal.restore():
        buffer.extend(readings)
    taken = len(buffer)
    # data written to a file survives the death of the writer
    accepted = os.open(f'{folder}.accepted', os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    while True:
        for _ in range(10):
            names = ('front', 'hinten links', '超音波')
            buffer.append(
                names[len(buffer) % 3],
                x=float(len(buffer)),
                y=0.0,
                yaw=0.0,
                z=1.0,
                z_max=4.0,
                half_angle=0.1,
                sigma=0.0,
                stamp=time.time_ns(),
            )
        os.write(accepted, struct.pack('<qq', len(buffer), time.time_ns()))
        time.sleep(0.01)
        if len(buffer) - taken > 50:
            journal.put(buffer.snapshot(taken), ('odom', 'base_link'), [(float(taken), 0.0)])
            taken = len(buffer)


if __name__ == '__main__':
    main(sys.argv[1])
