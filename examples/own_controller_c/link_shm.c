/* The shared-memory link: two rings in a file of /dev/shm, which the controller makes.

   Written from docs/own-controller.md alone; the numbers below are those of its tables. */

#include "link.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#define SCHEME "shm://"
#define FOLDER "/dev/shm/gfmhil-%u" /* of a user, by number */

static const char MAGIC[8] = "GFMHILSM"; /* eight letters, no zero at the end */

enum {
    VERSION = 1,
    SLOTS = 64,
    SLOT = 512, /* bytes: the stamp, and up to LONGEST bytes of a message */
    STAMP = 8,
    LENGTH_BITS = 16,
    AT_MAGIC = 0,
    AT_VERSION = 8,
    AT_OWNER = 16,
    AT_HEAD_IN = 128,  /* of the ring from the plant: we write it */
    AT_HEAD_OUT = 256, /* of the ring to the plant: the plant writes it */
    AT_IN = 512,
    AT_OUT = AT_IN + SLOTS * SLOT,
    SIZE = AT_OUT + SLOTS * SLOT,
    LOOKS = 2000,     /* before a wait begins to sleep */
    NAP_NS = 20000,
};

_Static_assert(SLOT - STAMP == LONGEST, "a slot holds a stamp and a message");
_Static_assert(ATOMIC_LLONG_LOCK_FREE == 2, "a stamp must be written at once");

typedef struct {
    int64_t process, start, namespace;
} identity_t;

struct link {
    char path[PATH_MAX];
    unsigned char *memory;
    int64_t sent, taken;
};

/* When a process began, in clock ticks since boot (proc_pid_stat(5), field 22); -1 if it ended. */
static int64_t start_of(int64_t process) {
    char name[64], text[1024], state;
    long long start;
    snprintf(name, sizeof name, "/proc/%lld/stat", (long long)process);
    FILE *file = fopen(name, "r");
    if (file == NULL)
        return -1;
    const size_t size = fread(text, 1, sizeof text - 1, file);
    fclose(file);
    text[size] = '\0';
    const char *rest = strrchr(text, ')'); /* the name before it may hold anything */
    const char *skip = " %c %*d %*d %*d %*d %*d %*u %*u %*u %*u %*u %*u %*u %*d %*d %*d %*d %*d %*d"
                       " %lld";
    if (rest == NULL || sscanf(rest + 1, skip, &state, &start) != 2)
        return -1;
    return state == 'Z' || state == 'X' ? -1 : start;
}

static identity_t myself(void) {
    struct stat namespace = {0};
    stat("/proc/self/ns/pid", &namespace);
    return (identity_t){getpid(), start_of(getpid()), (int64_t)namespace.st_ino};
}

/* Whether a process lives. One of another container cannot be seen and counts as alive. */
static bool lives(identity_t who) {
    return who.process != 0 &&
           (who.namespace != myself().namespace || start_of(who.process) == who.start);
}

/* Whether the file is what a dead controller left, so that it may be replaced. */
static bool is_left_over(const char *path) {
    unsigned char head[AT_OWNER + sizeof(identity_t)] = {0};
    static const unsigned char nothing[sizeof head];
    const int file = open(path, O_RDONLY | O_CLOEXEC);
    if (file < 0)
        return false;
    const ssize_t size = read(file, head, sizeof head);
    close(file);
    if (size < 0)
        return false;
    if (memcmp(head, nothing, sizeof head) == 0)
        return true; /* its maker ended before it had written a header */
    identity_t owner;
    memcpy(&owner, head + AT_OWNER, sizeof owner);
    return memcmp(head + AT_MAGIC, MAGIC, sizeof MAGIC) == 0 && !lives(owner);
}

/* Lock the folder of the user's links, which no other user may have any access to; -1 if it is none
   such. The lock is held while a link is made or removed, never during a run. */
static int lock(void) {
    char place[64];
    struct stat found;
    snprintf(place, sizeof place, FOLDER, (unsigned)geteuid());
    mkdir(place, 0700);
    const int folder = open(place, O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
    if (folder < 0 || fstat(folder, &found) != 0 || found.st_uid != geteuid() ||
        (found.st_mode & 077) != 0) {
        fprintf(stderr, "%s: is not a folder of this user alone\n", place);
        return -1;
    }
    flock(folder, LOCK_EX);
    return folder;
}

static _Atomic int64_t *word(link_t *link, size_t at) {
    return (_Atomic int64_t *)(void *)(link->memory + at);
}

static unsigned char *make(const char *path) {
    if (is_left_over(path))
        unlink(path);
    const int file = open(path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (file < 0)
        return NULL;
    unsigned char *memory = MAP_FAILED;
    errno = posix_fallocate(file, 0, SIZE); /* or a full /dev/shm would end us by SIGBUS */
    if (errno == 0)
        memory = mmap(NULL, SIZE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    const int why = errno;
    close(file);
    if (memory == MAP_FAILED) {
        unlink(path);
        errno = why;
        return NULL;
    }
    const int64_t version = VERSION;
    const identity_t owner = myself();
    memcpy(memory + AT_MAGIC, MAGIC, sizeof MAGIC);
    memcpy(memory + AT_VERSION, &version, sizeof version);
    memcpy(memory + AT_OWNER, &owner, sizeof owner);
    return memory;
}

link_t *link_open(const char *endpoint) {
    static struct link link;
    if (strncmp(endpoint, SCHEME, strlen(SCHEME)) != 0) {
        fprintf(stderr, "%s: must be shm://name\n", endpoint);
        return NULL;
    }
    snprintf(link.path, sizeof link.path, FOLDER "/link-%s", (unsigned)geteuid(),
             endpoint + strlen(SCHEME));
    const int folder = lock();
    if (folder < 0)
        return NULL;
    link.memory = make(link.path); /* the plant takes the lock too: it never sees half a header */
    if (link.memory == NULL)
        fprintf(stderr, "%s: cannot be created: %s\n", endpoint, strerror(errno));
    close(folder);
    return link.memory == NULL ? NULL : &link;
}

bool link_send(link_t *link, const void *message, size_t size) {
    const int64_t head = atomic_load_explicit(word(link, AT_HEAD_OUT), memory_order_acquire);
    if (size == 0 || size > LONGEST || link->sent - head >= SLOTS)
        return false;
    const size_t slot = AT_OUT + (size_t)(link->sent % SLOTS) * SLOT;
    memcpy(link->memory + slot + STAMP, message, size);
    link->sent++;
    const int64_t stamp = link->sent << LENGTH_BITS | (int64_t)size;
    atomic_store_explicit(word(link, slot), stamp, memory_order_release);
    return true;
}

static size_t take(link_t *link, void *message) {
    const size_t slot = AT_IN + (size_t)(link->taken % SLOTS) * SLOT;
    const int64_t stamp = atomic_load_explicit(word(link, slot), memory_order_acquire);
    if (stamp >> LENGTH_BITS != link->taken + 1)
        return 0;
    size_t size = (size_t)(stamp & ((1 << LENGTH_BITS) - 1));
    if (size > LONGEST)
        size = LONGEST; /* cannot be; but never read beyond the slot */
    memcpy(message, link->memory + slot + STAMP, size);
    link->taken++;
    atomic_store_explicit(word(link, AT_HEAD_IN), link->taken, memory_order_release);
    return size;
}

size_t link_receive(link_t *link, void *message, int wait_ms) {
    const struct timespec nap = {.tv_nsec = NAP_NS};
    struct timespec begin, now;
    clock_gettime(CLOCK_MONOTONIC, &begin);
    for (int look = 0;; look++) {
        const size_t size = take(link, message);
        if (size > 0)
            return size;
        if (look < LOOKS) {
            if (look % 16 == 15)
                sched_yield();
            continue;
        }
        if (nanosleep(&nap, NULL) != 0)
            return 0; /* a signal */
        clock_gettime(CLOCK_MONOTONIC, &now);
        if ((now.tv_sec - begin.tv_sec) * 1000 + (now.tv_nsec - begin.tv_nsec) / 1000000 >= wait_ms)
            return 0;
    }
}

void link_close(link_t *link) {
    const int folder = lock();
    unlink(link->path); /* a plant that has joined keeps the memory until it leaves */
    close(folder);
    munmap(link->memory, SIZE);
}
