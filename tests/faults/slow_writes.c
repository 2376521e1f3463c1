/* A disk that is slow, or stands still for a while: put in front of libc's pwrite by LD_PRELOAD.
 *
 * Writes of SLOW_FROM bytes and more take turns and last as long as SLOW_BYTES_S asks; number SLOW_STALL_AT of them
 * (from 1) lasts SLOW_STALL_S seconds in any case. Smaller writes (tables, journals) pass. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/types.h>
#include <time.h>

static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;
static long writes;

static double setting(const char *name) {
    const char *text = getenv(name);
    return text ? atof(text) : 0.0;
}

static void wait_s(double seconds) {
    struct timespec left = {(time_t)seconds, (long)((seconds - (time_t)seconds) * 1e9)};
    nanosleep(&left, NULL);
}

static void hold_up(size_t bytes) {
    if (bytes < (size_t)setting("SLOW_FROM")) return;
    pthread_mutex_lock(&turn);
    writes++;
    if (setting("SLOW_BYTES_S") > 0) wait_s(bytes / setting("SLOW_BYTES_S"));
    if (writes == (long)setting("SLOW_STALL_AT")) wait_s(setting("SLOW_STALL_S"));
    pthread_mutex_unlock(&turn);
}

typedef ssize_t (*writer)(int, const void *, size_t, off_t);

ssize_t pwrite(int fd, const void *data, size_t bytes, off_t offset) {
    hold_up(bytes);
    return ((writer)dlsym(RTLD_NEXT, "pwrite"))(fd, data, bytes, offset);
}

ssize_t pwrite64(int fd, const void *data, size_t bytes, off_t offset) {
    hold_up(bytes);
    return ((writer)dlsym(RTLD_NEXT, "pwrite64"))(fd, data, bytes, offset);
}
