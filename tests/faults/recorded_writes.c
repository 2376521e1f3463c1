/* Records what a process does to the files under RECORD_ROOT: put in front of libc by LD_PRELOAD.
 *
 * Each call is carried out and then appended to RECORD_LOG, one at a time, so that the log has the true order:
 * `struct entry`, then two names, then data. Calls that fail are not recorded. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OPEN = 1, WRITE, TRUNCATE, ALLOCATE, SYNC, RENAME, UNLINK, MKDIR, LINK, UNKNOWN };
struct entry {
    uint32_t op, handle;
    uint64_t offset, bytes;
    uint32_t name_bytes, second_bytes;
};

#define MOST_FDS 65536
static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;
static uint32_t handle_of[MOST_FDS], handles;
static int log_fd = -1;

static int ours(const char *path) {
    const char *root = getenv("RECORD_ROOT");
    return root && path && strncmp(path, root, strlen(root)) == 0;
}

static void put(const void *data, size_t bytes) {
    if (bytes && syscall(SYS_write, log_fd, data, bytes) != (ssize_t)bytes) abort();
}

static void note(uint32_t op, uint32_t handle, uint64_t offset, const void *data, uint64_t bytes, const char *name,
                 const char *second) {
    if (log_fd < 0)
        log_fd = syscall(SYS_openat, AT_FDCWD, getenv("RECORD_LOG"), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    struct entry entry = {op, handle, offset, bytes, name ? strlen(name) : 0, second ? strlen(second) : 0};
    put(&entry, sizeof entry);
    put(name, entry.name_bytes);
    put(second, entry.second_bytes);
    if (op == WRITE) put(data, bytes);
}

static uint32_t handle(int fd) { return fd >= 0 && fd < MOST_FDS ? handle_of[fd] : 0; }

static int opened(int fd, const char *path, int flags) {
    if (fd >= 0 && fd < MOST_FDS) {
        handle_of[fd] = 0;
        if (ours(path)) {
            handle_of[fd] = ++handles;
            note(OPEN, handles, flags & O_CREAT ? 1 : 0, NULL, flags & O_TRUNC ? 1 : 0, path, NULL);
        }
    }
    return fd;
}

#define LOCKED(type, call)               \
    pthread_mutex_lock(&turn);           \
    type result = (call);                \
    int error = errno;
#define UNLOCK                           \
    pthread_mutex_unlock(&turn);         \
    errno = error;                       \
    return result;

static mode_t mode_of(int flags, va_list rest) { return flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; }

#define OPENS(name)                                                                  \
    int name(const char *path, int flags, ...) {                                     \
        va_list rest;                                                                \
        va_start(rest, flags);                                                       \
        mode_t mode = mode_of(flags, rest);                                          \
        va_end(rest);                                                                \
        LOCKED(int, syscall(SYS_openat, AT_FDCWD, path, flags | O_LARGEFILE, mode))  \
        opened(result, path, flags);                                                 \
        UNLOCK                                                                       \
    }
OPENS(open)
OPENS(open64)

#define OPENATS(name)                                                        \
    int name(int folder, const char *path, int flags, ...) {                 \
        va_list rest;                                                        \
        va_start(rest, flags);                                               \
        mode_t mode = mode_of(flags, rest);                                  \
        va_end(rest);                                                        \
        LOCKED(int, syscall(SYS_openat, folder, path, flags | O_LARGEFILE, mode)) \
        opened(result, path, flags);                                         \
        UNLOCK                                                               \
    }
OPENATS(openat)
OPENATS(openat64)

int close(int fd) {
    LOCKED(int, syscall(SYS_close, fd))
    if (fd >= 0 && fd < MOST_FDS) handle_of[fd] = 0;
    UNLOCK
}

ssize_t write(int fd, const void *data, size_t bytes) {
    if (!handle(fd)) return syscall(SYS_write, fd, data, bytes);
    LOCKED(ssize_t, syscall(SYS_write, fd, data, bytes))
    if (result > 0) note(WRITE, handle(fd), syscall(SYS_lseek, fd, 0, SEEK_CUR) - result, data, result, NULL, NULL);
    UNLOCK
}

#define PWRITES(name)                                                              \
    ssize_t name(int fd, const void *data, size_t bytes, off_t offset) {           \
        if (!handle(fd)) return syscall(SYS_pwrite64, fd, data, bytes, offset);    \
        LOCKED(ssize_t, syscall(SYS_pwrite64, fd, data, bytes, offset))            \
        if (result > 0) note(WRITE, handle(fd), offset, data, result, NULL, NULL); \
        UNLOCK                                                                     \
    }
PWRITES(pwrite)
PWRITES(pwrite64)

#define TRUNCATES(name)                                                        \
    int name(int fd, off_t size) {                                             \
        LOCKED(int, syscall(SYS_ftruncate, fd, size))                          \
        if (result == 0 && handle(fd)) note(TRUNCATE, handle(fd), size, NULL, 0, NULL, NULL); \
        UNLOCK                                                                 \
    }
TRUNCATES(ftruncate)
TRUNCATES(ftruncate64)

#define TRUNCATES_BY_NAME(name)                                                \
    int name(const char *path, off_t size) {                                   \
        LOCKED(int, syscall(SYS_truncate, path, size))                         \
        if (result == 0 && ours(path)) note(TRUNCATE, 0, size, NULL, 0, path, NULL); \
        UNLOCK                                                                 \
    }
TRUNCATES_BY_NAME(truncate)
TRUNCATES_BY_NAME(truncate64)

#define ALLOCATES(name)                                                                        \
    int name(int fd, off_t offset, off_t bytes) {                                              \
        LOCKED(int, syscall(SYS_fallocate, fd, 0, offset, bytes) ? errno : 0)                  \
        if (result == 0 && handle(fd)) note(ALLOCATE, handle(fd), offset, NULL, bytes, NULL, NULL); \
        UNLOCK                                                                                 \
    }
ALLOCATES(posix_fallocate)
ALLOCATES(posix_fallocate64)

#define SYNCS(name, number)                                                              \
    int name(int fd) {                                                                   \
        LOCKED(int, syscall(number, fd))                                                 \
        if (result == 0 && handle(fd)) note(SYNC, handle(fd), 0, NULL, 0, NULL, NULL);   \
        UNLOCK                                                                           \
    }
SYNCS(fsync, SYS_fsync)
SYNCS(fdatasync, SYS_fdatasync)

int rename(const char *from, const char *to) {
    LOCKED(int, syscall(SYS_rename, from, to))
    if (result == 0 && ours(to)) note(RENAME, 0, 0, NULL, 0, from, to);
    UNLOCK
}

int link(const char *from, const char *to) {
    LOCKED(int, syscall(SYS_link, from, to))
    if (result == 0 && ours(to)) note(LINK, 0, 0, NULL, 0, from, to);
    UNLOCK
}

int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags) {
    LOCKED(int, syscall(SYS_linkat, from_folder, from, to_folder, to, flags))
    if (result == 0 && ours(to)) note(LINK, 0, 0, NULL, 0, from, to);
    UNLOCK
}

int unlink(const char *path) {
    LOCKED(int, syscall(SYS_unlink, path))
    if (result == 0 && ours(path)) note(UNLINK, 0, 0, NULL, 0, path, NULL);
    UNLOCK
}

int mkdir(const char *path, mode_t mode) {
    LOCKED(int, syscall(SYS_mkdir, path, mode))
    if (result == 0 && ours(path)) note(MKDIR, 0, 0, NULL, 0, path, NULL);
    UNLOCK
}

/* Ways to write that nothing here uses: if one is used after all, the log says so and the test fails. */
#define UNUSED(type, name, parameters, call, fd)                                            \
    type name parameters {                                                                  \
        LOCKED(type, call)                                                                  \
        if (handle(fd)) note(UNKNOWN, handle(fd), 0, NULL, 0, #name, NULL);                 \
        UNLOCK                                                                              \
    }
UNUSED(ssize_t, writev, (int fd, const struct iovec *parts, int count), syscall(SYS_writev, fd, parts, count), fd)
UNUSED(ssize_t, sendfile, (int fd, int from, off_t *offset, size_t bytes), syscall(SYS_sendfile, fd, from, offset, bytes), fd)
UNUSED(ssize_t, sendfile64, (int fd, int from, off_t *offset, size_t bytes), syscall(SYS_sendfile, fd, from, offset, bytes), fd)
UNUSED(ssize_t, copy_file_range, (int from, off_t *a, int fd, off_t *b, size_t bytes, unsigned flags), syscall(SYS_copy_file_range, from, a, fd, b, bytes, flags), fd)
