/* The one event there is: a new buffer. */
#define _POSIX_C_SOURCE 200809L
#include <string.h>
#include <time.h>

#include "stream.h"

struct Event {
    int registered, aborted;
};
static struct Event new_buffer;

GC_API GCRegisterEvent(EVENTSRC_HANDLE source, EVENT_TYPE type, EVENT_HANDLE *handle) {
    if (type != EVENT_NEW_BUFFER) return fail(GC_ERR_NOT_IMPLEMENTED, "only new buffers are told of");
    NEED(source, stream_module);
    if (new_buffer.registered) return fail(GC_ERR_RESOURCE_IN_USE, "the event is registered already");
    new_buffer = (struct Event){.registered = 1};
    stream.fired = 0;
    *handle = &new_buffer;
    return GC_ERR_SUCCESS;
}

#define NEED_EVENT(event) \
    if ((event) != &new_buffer || !new_buffer.registered) return fail(GC_ERR_INVALID_HANDLE, "no such event")

void cancel_event(void) {
    pthread_mutex_lock(&stream.mutex);
    new_buffer.registered = 0;
    pthread_cond_broadcast(&stream.changed);
    pthread_mutex_unlock(&stream.mutex);
}

GC_API GCUnregisterEvent(EVENTSRC_HANDLE source, EVENT_TYPE type) {
    NEED(source, stream_module);
    if (type != EVENT_NEW_BUFFER || !new_buffer.registered)
        return fail(GC_ERR_INVALID_PARAMETER, "the event is not registered");
    cancel_event();
    return GC_ERR_SUCCESS;
}

/* Whole until the cable breaks: what had come before is handed out first. */
GC_API EventGetData(EVENT_HANDLE event, void *data, size_t *size, uint64_t timeout_ms) {
    NEED_EVENT(event);
    struct timespec end;
    clock_gettime(CLOCK_REALTIME, &end);
    uint64_t end_ns = (uint64_t)end.tv_nsec + timeout_ms % 1000 * 1000000;
    end.tv_sec += (time_t)(timeout_ms > 1000000000 ? 1000000 : timeout_ms / 1000) + (time_t)(end_ns / 1000000000);
    end.tv_nsec = (long)(end_ns % 1000000000);
    pthread_mutex_lock(&stream.mutex);
    while (!stream.output.count && !stream.broken && event->registered && !event->aborted)
        if (!timeout_ms || pthread_cond_timedwait(&stream.changed, &stream.mutex, &end))
            return leave(fail(GC_ERR_TIMEOUT, "no image in time"));
    if (event->aborted || !event->registered) {
        event->aborted = 0;
        return leave(fail(GC_ERR_ABORT, "the wait was ended"));
    }
    if (!stream.output.count) return leave(fail(GC_ERR_IO, "the camera is gone"));
    struct Buffer *buffer = stream.output.line[stream.output.first];
    EVENT_NEW_BUFFER_DATA told = {buffer, buffer->user};
    GC_ERROR code = say((Answer){NULL, data, size}, 0, &told, sizeof told);
    if (code || !data) return leave(code);
    pop(&stream.output, IN_HAND);
    stream.delivered++;
    return leave(GC_ERR_SUCCESS);
}

GC_API EventGetDataInfo(EVENT_HANDLE event, const void *data, size_t data_size, INFO_CMD what, INFO_DATATYPE *type,
                        void *bytes, size_t *size) {
    NEED_EVENT(event);
    if (data_size < sizeof(EVENT_NEW_BUFFER_DATA)) return fail(GC_ERR_INVALID_PARAMETER, "not this event's data");
    EVENT_NEW_BUFFER_DATA told;
    memcpy(&told, data, sizeof told);
    Answer answer = {type, bytes, size};
    switch (what) {
    case EVENT_DATA_ID: return say_pointer(answer, told.buffer);
    case EVENT_DATA_VALUE: return say_pointer(answer, told.user);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "EventGetDataInfo");
    }
}

GC_API EventGetInfo(EVENT_HANDLE event, INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    NEED_EVENT(event);
    Answer answer = {type, bytes, size};
    switch (what) {
    case EVENT_EVENT_TYPE: return say_int32(answer, EVENT_NEW_BUFFER);
    case EVENT_NUM_IN_QUEUE: return say_size(answer, stream.output.count);
    case EVENT_NUM_FIRED: return say_uint64(answer, stream.fired);
    case EVENT_SIZE_MAX: case EVENT_INFO_DATA_SIZE_MAX: return say_size(answer, sizeof(EVENT_NEW_BUFFER_DATA));
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "EventGetInfo");
    }
}

GC_API EventFlush(EVENT_HANDLE event) {
    NEED_EVENT(event);
    discard(&stream.output);
    return GC_ERR_SUCCESS;
}

GC_API EventKill(EVENT_HANDLE event) {
    NEED_EVENT(event);
    pthread_mutex_lock(&stream.mutex);
    event->aborted = 1;
    pthread_cond_broadcast(&stream.changed);
    return leave(GC_ERR_SUCCESS);
}
