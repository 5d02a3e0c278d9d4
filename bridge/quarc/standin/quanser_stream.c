/*
 * The stand-in for Quanser's Stream API over POSIX sockets. Non-blocking streams only, on the loopback interface only:
 * behind it is no arm that another machine could move.
 */
#define _POSIX_C_SOURCE 200809L

#include "quanser_stream.h"
#include "standin.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

/* QUARC's default port. */
#define DEFAULT_PORT 18000

struct buffer {
    unsigned char *bytes;
    size_t size;
    size_t used;
};

struct tag_stream {
    int socket;
    /* Whether Nagle's algorithm is on, QUARC's default: small vectors wait for the acknowledgement of earlier ones. */
    bool nagle;
    bool swaps_bytes;
    bool is_at_end;
    struct buffer send;
    struct buffer receive;
};

static int socket_send_bytes = 0;

void standin_limit_socket(int send_bytes) {
    socket_send_bytes = send_bytes;
}

static bool set_non_blocking(int socket) {
    int flags = fcntl(socket, F_GETFL, 0);
    return flags >= 0 && fcntl(socket, F_SETFL, flags | O_NONBLOCK) == 0;
}

static t_stream new_stream(int socket, size_t send_size, size_t receive_size) {
    t_stream stream = calloc(1, sizeof *stream);
    if (stream == NULL) {
        return NULL;
    }
    stream->socket = socket;
    stream->send.bytes = malloc(send_size > 0 ? send_size : 1);
    stream->send.size = send_size;
    stream->receive.bytes = malloc(receive_size > 0 ? receive_size : 1);
    stream->receive.size = receive_size;
    if (stream->send.bytes == NULL || stream->receive.bytes == NULL) {
        free(stream->send.bytes);
        free(stream->receive.bytes);
        free(stream);
        return NULL;
    }
    return stream;
}

/* Reads the port of a URI. Returns -1 if it is malformed. */
static long port_of(const char *uri) {
    static const char scheme[] = "tcpip://";
    if (strncmp(uri, scheme, sizeof scheme - 1) != 0) {
        return -1;
    }
    const char *host = uri + sizeof scheme - 1;
    const char *colon = host + strcspn(host, ":?");
    if (*colon != ':') {
        return DEFAULT_PORT;
    }
    char *end = NULL;
    long port = strtol(colon + 1, &end, 10);
    bool is_whole = end != colon + 1 && (*end == '\0' || *end == '?' || *end == '/');
    return is_whole && port >= 0 && port <= 65535 ? port : -1;
}

t_error stream_listen(const char *uri, t_boolean non_blocking, t_stream *server_stream) {
    long port = port_of(uri);
    if (port < 0 || !non_blocking) {
        return -QERR_STANDIN_ARGUMENT;
    }
    int listener = socket(AF_INET, SOCK_STREAM, 0);
    if (listener < 0) {
        return -QERR_STANDIN_SOCKET;
    }
    int on = 1;
    struct sockaddr_in address;
    memset(&address, 0, sizeof address);
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    address.sin_port = htons((unsigned short)port);
    setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
    t_stream stream = NULL;
    if (bind(listener, (struct sockaddr *)&address, sizeof address) == 0 && listen(listener, 8) == 0 &&
        set_non_blocking(listener)) {
        stream = new_stream(listener, 0, 0);
    }
    if (stream == NULL) {
        close(listener);
        return -QERR_STANDIN_SOCKET;
    }
    stream->nagle = strstr(uri, "nagle='off'") == NULL;
    *server_stream = stream;
    return 0;
}

int standin_port(t_stream server_stream) {
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    if (getsockname(server_stream->socket, (struct sockaddr *)&address, &size) != 0) {
        return -1;
    }
    return ntohs(address.sin_port);
}

static bool is_would_block(int error) {
    return error == EAGAIN || error == EWOULDBLOCK || error == EINTR;
}

t_error stream_accept(t_stream server_stream, t_int send_buffer_size, t_int receive_buffer_size,
                      t_stream *client_stream) {
    if (send_buffer_size < 0 || receive_buffer_size < 0) {
        return -QERR_STANDIN_ARGUMENT;
    }
    int accepted = accept(server_stream->socket, NULL, NULL);
    if (accepted < 0) {
        return is_would_block(errno) ? -QERR_WOULD_BLOCK : -QERR_STANDIN_SOCKET;
    }
    int on = 1;
    if (!server_stream->nagle) {
        setsockopt(accepted, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    }
    if (socket_send_bytes > 0) {
        setsockopt(accepted, SOL_SOCKET, SO_SNDBUF, &socket_send_bytes, sizeof socket_send_bytes);
    }
    t_stream stream = NULL;
    if (set_non_blocking(accepted)) {
        stream = new_stream(accepted, (size_t)send_buffer_size, (size_t)receive_buffer_size);
    }
    if (stream == NULL) {
        close(accepted);
        return -QERR_STANDIN_MEMORY;
    }
    *client_stream = stream;
    return 0;
}

t_error stream_set_byte_order(t_stream stream, t_stream_byte_order byte_order) {
    const unsigned short probe = 1;
    unsigned char first = 0;
    memcpy(&first, &probe, 1);
    t_stream_byte_order native = first == 1 ? STREAM_BYTE_ORDER_LITTLE_ENDIAN : STREAM_BYTE_ORDER_BIG_ENDIAN;
    stream->swaps_bytes = byte_order != STREAM_BYTE_ORDER_NATIVE_ENDIAN && byte_order != native;
    return 0;
}

static void copy_doubles(unsigned char *to, const unsigned char *from, size_t n_bytes, bool swaps_bytes) {
    for (size_t i = 0; i < n_bytes; i++) {
        to[i] = from[swaps_bytes ? (i ^ 7) : i];
    }
}

static void remove_front(struct buffer *buffer, size_t n_bytes) {
    buffer->used -= n_bytes;
    memmove(buffer->bytes, buffer->bytes + n_bytes, buffer->used);
}

t_int stream_receive_double_array(t_stream stream, t_double *elements, t_uint num_elements) {
    struct buffer *buffer = &stream->receive;
    size_t n_bytes = sizeof(t_double) * num_elements;
    if (n_bytes > buffer->size) {
        return -QERR_STANDIN_ARGUMENT;
    }
    /* Reads ahead: as much as the buffer holds. */
    while (buffer->used < buffer->size && !stream->is_at_end) {
        ssize_t n = recv(stream->socket, buffer->bytes + buffer->used, buffer->size - buffer->used, 0);
        if (n > 0) {
            buffer->used += (size_t)n;
        } else if (n == 0) {
            stream->is_at_end = true;
        } else if (is_would_block(errno)) {
            break;
        } else {
            return -QERR_STANDIN_SOCKET;
        }
    }
    if (buffer->used < n_bytes) {
        return stream->is_at_end ? 0 : -QERR_WOULD_BLOCK;
    }
    copy_doubles((unsigned char *)elements, buffer->bytes, n_bytes, stream->swaps_bytes);
    remove_front(buffer, n_bytes);
    return 1;
}

t_error stream_flush(t_stream stream) {
    struct buffer *buffer = &stream->send;
    while (buffer->used > 0) {
        ssize_t n = send(stream->socket, buffer->bytes, buffer->used, MSG_NOSIGNAL);
        if (n < 0) {
            return is_would_block(errno) ? -QERR_WOULD_BLOCK : -QERR_STANDIN_SOCKET;
        }
        remove_front(buffer, (size_t)n);
    }
    return 0;
}

t_int stream_send_double_array(t_stream stream, const t_double *elements, t_uint num_elements) {
    struct buffer *buffer = &stream->send;
    size_t n_bytes = sizeof(t_double) * num_elements;
    if (n_bytes > buffer->size) {
        return -QERR_STANDIN_ARGUMENT;
    }
    if (buffer->size - buffer->used < n_bytes) {
        t_error result = stream_flush(stream);
        if (result != 0 && result != -QERR_WOULD_BLOCK) {
            return result;
        }
        if (buffer->size - buffer->used < n_bytes) {
            return -QERR_WOULD_BLOCK;
        }
    }
    copy_doubles(buffer->bytes + buffer->used, (const unsigned char *)elements, n_bytes, stream->swaps_bytes);
    buffer->used += n_bytes;
    return 1;
}

t_error stream_close(t_stream stream) {
    close(stream->socket);
    free(stream->send.bytes);
    free(stream->receive.bytes);
    free(stream);
    return 0;
}
