/* What the data stream's files share: the stream's state, and the lock that guards all of it. */
#ifndef STREAM_H
#define STREAM_H

#include <pthread.h>

#include "producer.h"

#define MOST_BUFFERS 512
#define LEAST_BUFFERS 3

/* What a frame says of itself, ahead of its pixels. */
typedef struct {
    uint64_t frame_id, timestamp;
    uint32_t width, height, left, top, pixel_format, bytes;
} Head;

typedef enum { FREE, IDLE, QUEUED, FILLED, IN_HAND } State;

struct Buffer {
    State state;
    int owned, incomplete, too_large;
    void *base, *user;
    size_t size, filled;
    Head head;
};

typedef struct {
    struct Buffer *line[MOST_BUFFERS];
    unsigned first, count;
} Queue;

typedef struct {
    pthread_mutex_t mutex;
    pthread_cond_t changed;
    struct Buffer buffers[MOST_BUFFERS];
    Queue input, output;
    int grabbing, broken; /* broken: the cable ended while grabbing */
    uint64_t started, delivered, underruns, fired;
} Stream;
extern Stream stream;

struct Buffer *pop(Queue *queue, State state);
void discard(Queue *queue);
GC_ERROR leave(GC_ERROR code);

#define NEED_BUFFER(buffer) \
    if ((buffer) < stream.buffers || (buffer) >= stream.buffers + MOST_BUFFERS || (buffer)->state == FREE) \
    return fail(GC_ERR_INVALID_HANDLE, "no such buffer")

#endif
