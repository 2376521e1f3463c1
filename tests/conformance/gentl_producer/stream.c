/* The data stream: announced buffers, filled by a thread of ours as frames come over the cable. */
#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <unistd.h>

#include "stream.h"

Module stream_module = {"TLDataStream", 0};
Stream stream = {.mutex = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};
static pthread_t reader;
static int cable = -1;

static void push(Queue *queue, struct Buffer *buffer, State state) {
    buffer->state = state;
    queue->line[(queue->first + queue->count++) % MOST_BUFFERS] = buffer;
}

struct Buffer *pop(Queue *queue, State state) {
    if (!queue->count) return NULL;
    struct Buffer *buffer = queue->line[queue->first];
    queue->first = (queue->first + 1) % MOST_BUFFERS;
    queue->count--;
    buffer->state = state;
    return buffer;
}

GC_ERROR leave(GC_ERROR code) {
    pthread_mutex_unlock(&stream.mutex);
    return code;
}

/* -- frames ---------------------------------------------------------------------------------------------- */

/* Takes one packet from the cable into the oldest queued buffer, or nowhere; false at the cable's end. */
static int receive(void) {
    Head head;
    struct Buffer *buffer = stream.input.count ? stream.input.line[stream.input.first] : NULL;
    struct iovec parts[] = {{&head, sizeof head}, {buffer ? buffer->base : NULL, buffer ? buffer->size : 0}};
    struct msghdr packet = {.msg_iov = parts, .msg_iovlen = 2};
    ssize_t got = recvmsg(cable, &packet, MSG_DONTWAIT);
    if (got < 0 && (errno == EAGAIN || errno == EINTR)) return 1;
    if (got < (ssize_t)sizeof head) return 0;
    stream.started++;
    if (!buffer) {
        stream.underruns++;
        return 1;
    }
    pop(&stream.input, IDLE);
    buffer->head = head;
    buffer->filled = (size_t)got - sizeof head;
    buffer->too_large = head.bytes > buffer->size;
    buffer->incomplete = buffer->filled != head.bytes;
    push(&stream.output, buffer, FILLED);
    stream.fired++;
    return 1;
}

static void *read_frames(void *unused) {
    (void)unused;
    struct pollfd ready = {.fd = cable, .events = POLLIN};
    for (int alive = 1; alive;) {
        poll(&ready, 1, -1);
        pthread_mutex_lock(&stream.mutex);
        alive = stream.grabbing && receive();
        if (!alive && stream.grabbing) stream.broken = 1;
        pthread_cond_broadcast(&stream.changed);
        pthread_mutex_unlock(&stream.mutex);
    }
    return NULL;
}

GC_API DSStartAcquisition(DS_HANDLE module, START_FLAGS flags, uint64_t images) {
    (void)flags, (void)images;
    NEED(module, stream_module);
    if (stream.grabbing) return fail(GC_ERR_RESOURCE_IN_USE, "the acquisition runs already");
    GC_ERROR code = connect_frames(&cable);
    if (code) return code;
    stream.started = stream.delivered = stream.underruns = 0;
    stream.broken = 0;
    stream.grabbing = 1;
    if (pthread_create(&reader, NULL, read_frames, NULL)) {
        stream.grabbing = 0;
        close(cable);
        return fail(GC_ERR_RESOURCE_EXHAUSTED, "no thread");
    }
    return GC_ERR_SUCCESS;
}

static void stop(void) {
    pthread_mutex_lock(&stream.mutex);
    int was_grabbing = stream.grabbing;
    stream.grabbing = 0;
    pthread_mutex_unlock(&stream.mutex);
    if (!was_grabbing) return;
    shutdown(cable, SHUT_RDWR);
    pthread_join(reader, NULL);
    close(cable);
}

GC_API DSStopAcquisition(DS_HANDLE module, STOP_FLAGS flags) {
    (void)flags;
    NEED(module, stream_module);
    stop();
    return GC_ERR_SUCCESS;
}

/* -- buffers --------------------------------------------------------------------------------------------- */

static GC_ERROR announce(void *base, size_t size, void *user, int owned, BUFFER_HANDLE *handle) {
    pthread_mutex_lock(&stream.mutex);
    for (unsigned k = 0; k < MOST_BUFFERS; k++)
        if (stream.buffers[k].state == FREE) {
            stream.buffers[k] = (struct Buffer){IDLE, .base = base, .size = size, .user = user, .owned = owned};
            *handle = &stream.buffers[k];
            return leave(GC_ERR_SUCCESS);
        }
    return leave(fail(GC_ERR_RESOURCE_EXHAUSTED, "too many buffers"));
}

GC_API DSAnnounceBuffer(DS_HANDLE module, void *base, size_t size, void *user, BUFFER_HANDLE *handle) {
    NEED(module, stream_module);
    return announce(base, size, user, 0, handle);
}

GC_API DSAllocAndAnnounceBuffer(DS_HANDLE module, size_t size, void *user, BUFFER_HANDLE *handle) {
    NEED(module, stream_module);
    void *base = malloc(size);
    if (!base) return fail(GC_ERR_RESOURCE_EXHAUSTED, "no memory");
    GC_ERROR code = announce(base, size, user, 1, handle);
    if (code) free(base);
    return code;
}

GC_API DSRevokeBuffer(DS_HANDLE module, BUFFER_HANDLE buffer, void **base, void **user) {
    NEED(module, stream_module);
    NEED_BUFFER(buffer);
    if (buffer->state == QUEUED || buffer->state == FILLED) return fail(GC_ERR_BUSY, "the buffer is queued");
    if (base) *base = buffer->owned ? NULL : buffer->base;
    if (user) *user = buffer->user;
    if (buffer->owned) free(buffer->base);
    buffer->state = FREE;
    return GC_ERR_SUCCESS;
}

GC_API DSQueueBuffer(DS_HANDLE module, BUFFER_HANDLE buffer) {
    NEED(module, stream_module);
    NEED_BUFFER(buffer);
    pthread_mutex_lock(&stream.mutex);
    if (buffer->state == QUEUED || buffer->state == FILLED)
        return leave(fail(GC_ERR_RESOURCE_IN_USE, "the buffer is queued already"));
    push(&stream.input, buffer, QUEUED);
    return leave(GC_ERR_SUCCESS);
}

void discard(Queue *queue) {
    pthread_mutex_lock(&stream.mutex);
    while (pop(queue, IDLE)) continue;
    pthread_mutex_unlock(&stream.mutex);
}

GC_API DSFlushQueue(DS_HANDLE module, QUEUE_OPERATION operation) {
    NEED(module, stream_module);
    if (operation != ACQ_QUEUE_ALL_DISCARD && operation != ACQ_QUEUE_OUTPUT_DISCARD)
        return fail(GC_ERR_NOT_IMPLEMENTED, "DSFlushQueue: this operation");
    discard(&stream.output);
    if (operation == ACQ_QUEUE_ALL_DISCARD) discard(&stream.input);
    return GC_ERR_SUCCESS;
}

GC_ERROR close_stream(void) {
    stop();
    cancel_event();
    discard(&stream.input);
    discard(&stream.output);
    for (unsigned k = 0; k < MOST_BUFFERS; k++)
        if (stream.buffers[k].state != FREE) DSRevokeBuffer(&stream_module, &stream.buffers[k], NULL, NULL);
    stream_module.open = 0;
    return GC_ERR_SUCCESS;
}

GC_API DSClose(DS_HANDLE module) {
    NEED(module, stream_module);
    return close_stream();
}
