/* What the data stream tells of itself and of its buffers. */
#include "stream.h"

GC_API DSGetParentDev(DS_HANDLE module, DEV_HANDLE *device) {
    NEED(module, stream_module);
    *device = &device_module;
    return GC_ERR_SUCCESS;
}

static size_t announced(void) {
    size_t count = 0;
    for (unsigned k = 0; k < MOST_BUFFERS; k++) count += stream.buffers[k].state != FREE;
    return count;
}

GC_API DSGetInfo(DS_HANDLE module, INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    NEED(module, stream_module);
    Answer answer = {type, bytes, size};
    switch (what) {
    case STREAM_INFO_ID: return say_text(answer, "frames");
    case STREAM_INFO_TLTYPE: return say_text(answer, device_identity()->tl_type);
    case STREAM_INFO_NUM_DELIVERED: return say_uint64(answer, stream.delivered);
    case STREAM_INFO_NUM_UNDERRUN: return say_uint64(answer, stream.underruns);
    case STREAM_INFO_NUM_STARTED: return say_uint64(answer, stream.started);
    case STREAM_INFO_NUM_ANNOUNCED: return say_size(answer, announced());
    case STREAM_INFO_NUM_QUEUED: return say_size(answer, stream.input.count);
    case STREAM_INFO_NUM_AWAIT_DELIVERY: return say_size(answer, stream.output.count);
    case STREAM_INFO_IS_GRABBING: return say_bool(answer, stream.grabbing);
    case STREAM_INFO_DEFINES_PAYLOADSIZE: return say_bool(answer, 0); /* the camera's PayloadSize does */
    case STREAM_INFO_NUM_CHUNKS_MAX: return say_size(answer, 0);
    case STREAM_INFO_BUF_ANNOUNCE_MIN: return say_size(answer, LEAST_BUFFERS);
    case STREAM_INFO_BUF_ALIGNMENT: return say_size(answer, 1);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "DSGetInfo");
    }
}

GC_API DSGetBufferID(DS_HANDLE module, uint32_t index, BUFFER_HANDLE *handle) {
    NEED(module, stream_module);
    for (unsigned k = 0; k < MOST_BUFFERS; k++)
        if (stream.buffers[k].state != FREE && !index--) {
            *handle = &stream.buffers[k];
            return GC_ERR_SUCCESS;
        }
    return fail(GC_ERR_INVALID_INDEX, "no such buffer");
}

GC_API DSGetBufferInfo(DS_HANDLE module, BUFFER_HANDLE buffer, INFO_CMD what, INFO_DATATYPE *type, void *bytes,
                       size_t *size) {
    NEED(module, stream_module);
    NEED_BUFFER(buffer);
    Answer answer = {type, bytes, size};
    const Head *head = &buffer->head;
    switch (what) {
    case BUFFER_INFO_BASE: return say_pointer(answer, buffer->base);
    case BUFFER_INFO_SIZE: return say_size(answer, buffer->size);
    case BUFFER_INFO_USER_PTR: return say_pointer(answer, buffer->user);
    case BUFFER_INFO_TLTYPE: return say_text(answer, device_identity()->tl_type);
    case BUFFER_INFO_IS_QUEUED: return say_bool(answer, buffer->state == QUEUED || buffer->state == FILLED);
    case BUFFER_INFO_IS_ACQUIRING: return say_bool(answer, 0);
    case BUFFER_INFO_NEW_DATA: case BUFFER_INFO_IMAGEPRESENT:
        return say_bool(answer, buffer->state == FILLED || buffer->state == IN_HAND);
    case BUFFER_INFO_IS_INCOMPLETE: return say_bool(answer, buffer->incomplete);
    case BUFFER_INFO_DATA_LARGER_THAN_BUFFER: return say_bool(answer, buffer->too_large);
    case BUFFER_INFO_CONTAINS_CHUNKDATA: return say_bool(answer, 0);
    case BUFFER_INFO_SIZE_FILLED: return say_size(answer, buffer->filled);
    case BUFFER_INFO_DATA_SIZE: return say_size(answer, head->bytes);
    case BUFFER_INFO_TIMESTAMP: return say_uint64(answer, head->timestamp);
    case BUFFER_INFO_TIMESTAMP_NS:
        if (device_identity()->ticks_hz != 1000000000) return fail(GC_ERR_NOT_AVAILABLE, "timestamps are ticks");
        return say_uint64(answer, head->timestamp);
    case BUFFER_INFO_FRAMEID: return say_uint64(answer, head->frame_id);
    case BUFFER_INFO_WIDTH: return say_size(answer, head->width);
    case BUFFER_INFO_HEIGHT: return say_size(answer, head->height);
    case BUFFER_INFO_XOFFSET: return say_size(answer, head->left);
    case BUFFER_INFO_YOFFSET: return say_size(answer, head->top);
    case BUFFER_INFO_XPADDING: case BUFFER_INFO_YPADDING: case BUFFER_INFO_IMAGEOFFSET: return say_size(answer, 0);
    case BUFFER_INFO_PAYLOADTYPE: return say_size(answer, PAYLOAD_TYPE_IMAGE);
    case BUFFER_INFO_PIXELFORMAT: return say_uint64(answer, head->pixel_format);
    case BUFFER_INFO_PIXELFORMAT_NAMESPACE: return say_uint64(answer, PIXELFORMAT_NAMESPACE_PFNC_32BIT);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "DSGetBufferInfo");
    }
}

/* Plain images have neither chunks nor parts. */
GC_API DSGetBufferChunkData(DS_HANDLE module, BUFFER_HANDLE buffer, void *chunks, size_t *count) {
    (void)chunks, (void)count;
    NEED(module, stream_module);
    NEED_BUFFER(buffer);
    return fail(GC_ERR_NO_DATA, "the image has no chunks");
}

GC_API DSGetNumBufferParts(DS_HANDLE module, BUFFER_HANDLE buffer, uint32_t *count) {
    (void)count;
    NEED(module, stream_module);
    NEED_BUFFER(buffer);
    return fail(GC_ERR_NO_DATA, "the image has no parts");
}
