/* The cable to the camera: packets on Unix sockets, registers on one and frames on another.
 *
 * A client's first packet says what it wants: `look` (the answer is an Identity), `control` or `frames` (the
 * answer is `+`, or `-` while somebody else is in control). Then each packet on the control socket is a Request with
 * the bytes to write, and is answered with a code of GenTL and the bytes that were read; each on the other is a frame
 * (stream.h). */
#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <unistd.h>

#include "producer.h"

#define PATIENCE_S 5
#define MOST_BYTES 65536

typedef struct {
    uint32_t is_write, size;
    uint64_t address;
} Request;

static pthread_mutex_t asking = PTHREAD_MUTEX_INITIALIZER;
static int control = -1;
static char control_path[108];

static GC_ERROR reach(const char *camera, const char *purpose, void *answer, size_t size, int *cable) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    struct timeval patience = {.tv_sec = PATIENCE_S};
    if (strlen(camera) >= sizeof address.sun_path) return fail(GC_ERR_INVALID_ID, "the camera's path is too long");
    strcpy(address.sun_path, camera);
    *cable = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    setsockopt(*cable, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    if (!connect(*cable, (struct sockaddr *)&address, sizeof address) &&
        send(*cable, purpose, strlen(purpose), MSG_NOSIGNAL) > 0 && recv(*cable, answer, size, 0) > 0)
        return GC_ERR_SUCCESS;
    close(*cable);
    *cable = -1;
    return fail(GC_ERR_IO, "the camera does not answer");
}

GC_ERROR look_at(const char *camera, Identity *identity) {
    int cable;
    GC_ERROR code = reach(camera, "look", identity, sizeof *identity, &cable);
    if (!code) close(cable);
    return code;
}

static GC_ERROR connect_for(const char *camera, const char *purpose, int *cable) {
    char answer = 0;
    GC_ERROR code = reach(camera, purpose, &answer, 1, cable);
    if (code || answer == '+') return code;
    close(*cable);
    *cable = -1;
    return fail(GC_ERR_RESOURCE_IN_USE, "another client has the camera");
}

GC_ERROR take_hold(const char *camera) {
    GC_ERROR code = connect_for(camera, "control", &control);
    if (!code) strcpy(control_path, camera);
    return code;
}

GC_ERROR let_go(void) {
    pthread_mutex_lock(&asking);
    if (control >= 0) close(control);
    control = -1;
    pthread_mutex_unlock(&asking);
    return GC_ERR_SUCCESS;
}

GC_ERROR connect_frames(int *cable) { return connect_for(control_path, "frames", cable); }

/* One question and its answer. */
static GC_ERROR ask(Request request, const void *given, void *wanted) {
    int32_t code = GC_ERR_IO;
    struct iovec out[] = {{&request, sizeof request}, {(void *)given, request.is_write ? request.size : 0}};
    struct iovec in[] = {{&code, sizeof code}, {wanted, request.is_write ? 0 : request.size}};
    struct msghdr question = {.msg_iov = out, .msg_iovlen = 2}, answer = {.msg_iov = in, .msg_iovlen = 2};
    if (request.size > MOST_BYTES) return fail(GC_ERR_INVALID_PARAMETER, "too many bytes at once");
    pthread_mutex_lock(&asking);
    ssize_t got = sendmsg(control, &question, MSG_NOSIGNAL) < 0 ? -1 : recvmsg(control, &answer, 0);
    int late = got < 0 && (errno == EAGAIN || errno == EWOULDBLOCK);
    pthread_mutex_unlock(&asking);
    if (late) return fail(GC_ERR_TIMEOUT, "the camera did not answer in time");
    if (got < (ssize_t)sizeof code) return fail(GC_ERR_IO, "the camera is gone");
    return code ? fail(code, "the camera refuses") : GC_ERR_SUCCESS;
}

GC_ERROR read_registers(uint64_t address, void *data, size_t size) {
    return ask((Request){0, (uint32_t)size, address}, NULL, data);
}

GC_ERROR write_registers(uint64_t address, const void *data, size_t size) {
    return ask((Request){1, (uint32_t)size, address}, data, NULL);
}
