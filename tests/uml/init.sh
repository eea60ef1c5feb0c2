#!/bin/sh
# First process of user-mode Linux: brings up a virtual CAN FD bus, runs the script UML_JOB, writes
# its exit status to UML_STATUS and powers off. Both are paths given on the kernel's command line;
# its root is the host's own file system, in which it writes as the user who started it.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mkdir -p /dev/shm
mount -t tmpfs shm /dev/shm
kernel="/usr/lib/uml/modules/$(uname -r)/kernel"
for module in drivers/net/can/dev/can-dev net/can/can net/can/can-raw drivers/net/can/vcan \
    drivers/net/veth net/sched/sch_netem; do
  insmod "$kernel/$module.ko"
done
ip link set lo up
ip link add vcan0 mtu 72 type vcan
ip link set vcan0 up
sh "$UML_JOB"
echo $? >"$UML_STATUS"
sync
echo o >/proc/sysrq-trigger
sleep 60
